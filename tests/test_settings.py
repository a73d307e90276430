"""Settings as text: written with explanations, read back equal, wrong names and values refused."""

import enum
import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal, get_type_hints

import pytest

from odomap.errors import ConfigError
from odomap.limits import Limits, check_limits
from odomap.settings import config_to_yaml, field_docs, override, read_config
from odomap.system.config import PRESETS, Config, preset

NUMBERS = [
    (section.name, name)
    for section in fields(Config)
    for name, hint in get_type_hints(section.type).items()
    if hint in (int, float)
]


class Mode(enum.StrEnum):
    FAST = "fast"
    SLOW = "slow"


@dataclass(frozen=True)
class Section:
    """A section."""

    count: Annotated[int, Limits(least=1)] = 4
    """How many, at least 1."""
    gain: float = 1e-5
    """A small number, no unit."""
    name: str = "yes"
    """Text that YAML would take for a truth value."""
    kind: Literal["flow", "orb"] = "flow"
    mode: Mode = Mode.FAST
    pair: tuple[float, float] = (1.0, 2.0)
    many: tuple[int, ...] = ()
    limit: float | None = None
    active: bool = True
    folder: Path = Path("a")

    def __post_init__(self):
        check_limits(self)
        if self.pair[0] > self.pair[1]:
            raise ConfigError("pair: the first must not be above the second")


@dataclass(frozen=True)
class Tree:
    """All."""

    section: Section = field(default_factory=Section)
    """What it is for."""


def test_docs_are_read_from_under_the_fields():
    assert field_docs(Section)["count"] == "How many, at least 1."
    assert "kind" not in field_docs(Section)


def test_text_explains_itself():
    text = config_to_yaml(Tree(), {"data": "x: y"})
    assert "# What it is for.\nsection:\n  # How many, at least 1.\n  count: 4\n" in text
    assert "data: 'x: y'\n" in text


@pytest.mark.parametrize(
    "tree",
    [
        Tree(),
        Tree(
            Section(9, -2e30, "no: [", "orb", Mode.SLOW, (0.1, 5.0), (1, 2), 3.5, False, Path("b"))
        ),
        Tree(Section(gain=math.inf)),
    ],
)
def test_what_is_written_is_read_back(tree, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(config_to_yaml(tree, {"odomap": "0.1", "data": "d"}))
    assert read_config(path, Tree()) == tree


def test_what_a_file_does_not_say_stays(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("section: {gain: 2}\n")
    assert read_config(path, Tree(Section(count=7))) == Tree(Section(count=7, gain=2.0))
    path.write_text("")
    assert read_config(path, Tree()) == Tree()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sectoin: {}", "unknown field 'sectoin' (did you mean 'section'?)"),
        ("section: {cuont: 3}", "unknown field 'section.cuont' (did you mean 'count'?)"),
        ("section: {zzz: 3}", "(known: active, count, folder"),
        ("section: {count: 3.5}", "field 'section.count' is 3.5, a whole number expected"),
        ("section: {count: true}", "a whole number expected"),
        ("section: {gain: many}", "field 'section.gain' is 'many', a number expected"),
        ("section: {gain: .nan}", "not a number"),
        ("section: {kind: obr}", "one of flow, orb expected (did you mean 'orb'?)"),
        ("section: {mode: mid}", "one of fast, slow expected"),
        ("section: {pair: [1]}", "has 1 values, 2 expected"),
        ("section: {active: 1}", "true or false expected"),
        ("section: {count: 0}", ": section.count: 0 must be at least 1"),
        ("section: {pair: [2, 1]}", ": section.pair: the first must not be above the second"),
        ("section: 3", "'section' is a section"),
        ("- 1", "expected 'section:' lines"),
        ("a: [", "line 1: not YAML"),
        ("odomap_config: 2", "this odomap reads 1"),
    ],
)
def test_wrong_files_are_refused_with_file_field_and_mend(text, message, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_config(path, Tree())
    assert message in str(error.value)
    assert str(path) in str(error.value)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        read_config(tmp_path / "none.yaml", Tree())
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a text file"):
        read_config(tmp_path / "b.yaml", Tree())


def test_overrides():
    tree = override(Tree(), [("section.count", "8"), ("section.limit", "null")])
    assert tree.section.count == 8
    with pytest.raises(ConfigError, match=r"unknown field 'section\.cout' \(did you mean 'count'"):
        override(Tree(), [("section.cout", "8")])


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_the_file(name, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(config_to_yaml(preset(name)))
    other = next(iter(PRESETS))
    assert read_config(path, preset(other)) == preset(name)


def test_every_field_of_every_section_is_explained():
    config = preset(next(iter(PRESETS)))
    for section in fields(config):
        value = getattr(config, section.name)
        missing = {f.name for f in fields(value)} - set(field_docs(type(value)))
        assert not missing, f"{type(value).__name__}: no docstring under {missing}"


@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_every_number_of_every_section_has_limits(section, name):
    made = getattr(Config(), section)
    for value in (math.nan, math.inf, -1_000_000):
        with pytest.raises(ConfigError, match=rf"^{name}: {value} must be "):
            replace(made, **{name: value})
    with pytest.raises(
        ConfigError, match=rf"^command line: {section}\.{name}: -1000000(\.0)? must "
    ):
        override(Config(), [(f"{section}.{name}", "-1000000")])


def test_numbers_of_sections_are_found():
    numbered = {section.name for section in fields(Config)} - {"places"}  # which has a name alone
    assert {section for section, _ in NUMBERS} == numbered
    assert ("features", "count") in NUMBERS


@pytest.mark.parametrize(
    ("limits", "inside", "outside", "words"),
    [
        (Limits(above=0), (1, 1e-300), (0, -1), "above 0"),
        (Limits(least=8), (8, 9), (7, 7.999), "at least 8"),
        (Limits(above=0, most=180), (1e-9, 180), (0, 180.1), "above 0 and at most 180"),
        (Limits(least=-1, most=1), (-1, 0, 1), (-1.1, 1.1), "at least -1 and at most 1"),
        (Limits(), (-1e300, 0), (), ""),
    ],
)
def test_limits(limits, inside, outside, words):
    assert all(limits.admit(value) for value in inside)
    assert not any(limits.admit(value) for value in (*outside, math.nan, math.inf, -math.inf))
    assert str(limits) == words


def test_the_nearest_depth_is_below_the_farthest():
    with pytest.raises(ConfigError, match=r"depth\.nearest: 8\.0 must be below farthest, 8\.0$"):
        override(Config(), [("depth.nearest", "8")])


def test_overrides_count_together():
    """The first alone would put the nearest depth beyond the farthest."""
    config = override(Config(), [("depth.nearest", "9"), ("depth.farthest", "20")])
    assert (config.depth.nearest, config.depth.farthest) == (9.0, 20.0)
    config = override(Config(), [("depth.noise", "1"), ("flow.levels", "2"), ("depth.noise", "3")])
    assert (config.depth.noise, config.flow.levels) == (3.0, 2)
    assert override(Config(), []) == Config()
    for twice in (["depth", "depth.noise"], ["depth.noise", "depth"]):
        with pytest.raises(ConfigError, match="'depth' is given as a value and as a section"):
            override(Config(), [(name, "1") for name in twice])
