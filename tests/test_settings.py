"""Settings as text: written with explanations, read back equal, wrong names and values refused."""

import enum
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from odomap.errors import ConfigError
from odomap.settings import config_to_yaml, field_docs, override, read_config
from odomap.system.config import PRESETS, preset


class Mode(enum.StrEnum):
    FAST = "fast"
    SLOW = "slow"


@dataclass(frozen=True)
class Section:
    """A section."""

    count: int = 4
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
        if self.count < 1:
            raise ConfigError(f"field 'count' is {self.count}: at least 1 expected")


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
        ("section: {count: 0}", "field 'count' is 0: at least 1 expected"),
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
    from dataclasses import fields

    config = preset(next(iter(PRESETS)))
    for section in fields(config):
        value = getattr(config, section.name)
        missing = {f.name for f in fields(value)} - set(field_docs(type(value)))
        assert not missing, f"{type(value).__name__}: no docstring under {missing}"
