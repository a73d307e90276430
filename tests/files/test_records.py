"""Records are the same bytes for the same content, and JSON that any reader takes."""

import json
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest
import yaml

from odomap.errors import InputError
from odomap.files.records import plain, read_json, write_json, write_yaml


class Kind(StrEnum):
    ROOM = "room"


@dataclass
class Settings:
    kind: Kind
    sizes: tuple[int, ...]


CONTENT = {
    "b": np.float32(0.5),
    "a": np.arange(3),
    "nan": float("nan"),
    "inside": {"inf": np.inf, "yes": True, "none": None, "where": Path("x/y")},
    "settings": Settings(Kind.ROOM, (1, 2)),
    "third": 1 / 3,
}


def test_json_there_and_back(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", CONTENT)
    text = (tmp_path / "a.json").read_text()
    assert list(json.loads(text)) == ["b", "a", "nan", "inside", "settings", "third"]
    assert read_json(tmp_path / "a.json") == {
        "b": 0.5,
        "a": [0, 1, 2],
        "nan": None,
        "inside": {"inf": None, "yes": True, "none": None, "where": "x/y"},
        "settings": {"kind": "room", "sizes": [1, 2]},
        "third": 1 / 3,
    }
    write_json(tmp_path / "b.json", CONTENT)
    assert (tmp_path / "b.json").read_text() == text


def test_yaml_there_and_back(tmp_path: Path) -> None:
    write_yaml(tmp_path / "a.yaml", CONTENT)
    assert yaml.safe_load((tmp_path / "a.yaml").read_text()) == plain(CONTENT)


def test_what_has_no_plain_form_is_refused() -> None:
    with pytest.raises(TypeError, match="complex"):
        plain({"a": [1j]})


def test_broken_json_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": 1,\n"b": }')
    with pytest.raises(InputError, match=r"a\.json:2: not valid JSON"):
        read_json(tmp_path / "a.json")
