"""Fields: reading a mapping from a YAML file with a complaint for every way it can be wrong.

A description is a mapping of fields. Each is asked for by name and kind; one that is missing,
mistyped or of another kind is reported with the file, the field, and the nearest name that is
there. Only plain YAML is accepted: no tags that construct objects, except OpenCV's matrix, which
is a mapping.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from odomap.errors import CalibrationError, nearest_name
from odomap.files.text import read_text
from odomap.geometry.pose import SE3

__all__ = ["Fields", "read_yaml"]

ROTATION_TOLERANCE = 1e-3
"""How far a written rotation may be from orthonormal: three to four printed digits."""

EXACT = 1e-14
"""A rotation that is one up to rounding is taken as it stands."""


class _Loader(yaml.SafeLoader):
    """Safe YAML that also reads OpenCV's matrices, as mappings."""


def _mapping(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            problem="a matrix must have rows, cols and data", problem_mark=node.start_mark
        )
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _mapping)


def read_yaml(path: Path) -> "Fields":
    """Read a YAML file that holds one mapping.

    OpenCV writes the header ``%YAML:1.0``, which is not YAML; it is skipped.

    Raises:
        CalibrationError: it is not YAML, or not a mapping.
        InputError: it cannot be read.
    """
    text = read_text(path)
    if text.startswith("%YAML"):
        text = "\n" + text.partition("\n")[2]
    try:
        content = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "broken"
        raise CalibrationError(f"{path}{line}: not valid YAML: {problem}") from error
    if not isinstance(content, Mapping):
        raise CalibrationError(f"{path}: expected 'field: value' lines, found {_kind(content)}")
    return Fields(str(path), content)


class Fields:
    """The fields of one mapping, and where they stand."""

    def __init__(self, where: str, content: Mapping[str, Any]) -> None:
        """Wrap a mapping.

        Args:
            where: file and path of fields that lead here, for messages.
            content: the mapping.
        """
        self.where = where
        self.content = {str(key): value for key, value in content.items()}

    def __contains__(self, name: str) -> bool:
        return self.content.get(name) is not None

    def get(self, name: str) -> Any:
        """Return the value of a field that must be there.

        Raises:
            CalibrationError: it is missing; names the nearest field that is there.
        """
        if name in self:
            return self.content[name]
        if name in self.content:
            raise CalibrationError(f"{self.where}: field '{name}' is empty")
        close = nearest_name(name, self.content)
        found = f" (found {close.split(' ')[-1][:-2]}: rename it)" if close else ""
        raise CalibrationError(f"{self.where}: field '{name}' is missing{found}")

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number; the default, if there is one, where the field is missing."""
        if default is not None and name not in self.content:
            return default
        return self._number(name, self.get(name))

    def numbers(self, name: str, counts: Iterable[int] = ()) -> NDArray[np.float64]:
        """Return a list of finite numbers, whose length must be one of `counts` if given."""
        value = self.get(name)
        if not isinstance(value, (list, tuple)):
            raise self.error(name, f"must be a list of numbers, not {_kind(value)}")
        array = np.array([self._number(name, item) for item in value], np.float64)
        counts = tuple(counts)
        if counts and len(array) not in counts:
            expected = " or ".join(str(count) for count in counts)
            raise self.error(name, f"must have {expected} numbers, not {len(array)}")
        return array

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text; the default, if there is one, where the field is missing."""
        if default is not None and name not in self.content:
            return default
        value = self.get(name)
        if not isinstance(value, str):
            raise self.error(name, f"must be a text, not {_kind(value)}")
        return value

    def resolution(self, name: str) -> tuple[int, int]:
        """Return width and height in pixels."""
        size = self.numbers(name, (2,))
        if np.any(size < 1) or np.any(size != np.round(size)):
            raise self.error(name, "must be [width, height] in whole pixels")
        return int(size[0]), int(size[1])

    def transform(self, name: str) -> SE3:
        """Return a 4x4 rigid transform: rows, 16 numbers, or OpenCV's matrix with `data`.

        The rotation may be printed with few digits; the nearest true rotation is taken.
        """
        value = self.get(name)
        if isinstance(value, Mapping):
            value = Fields(f"{self.where}: {name}", value).get("data")
        if isinstance(value, (list, tuple)) and value and isinstance(value[0], (list, tuple)):
            if [len(row) if isinstance(row, (list, tuple)) else 0 for row in value] != [4] * 4:
                raise self.error(name, "must be four rows of four numbers")
            value = [item for row in value for item in row]
        if not isinstance(value, (list, tuple)) or len(value) != 16:
            raise self.error(name, "must be a 4x4 matrix: 16 numbers, row by row")
        matrix = np.array([self._number(name, item) for item in value]).reshape(4, 4)
        return self._se3(name, matrix)

    def section(self, name: str) -> "Fields":
        """Return a field that is itself a mapping."""
        value = self.get(name)
        if not isinstance(value, Mapping):
            raise self.error(name, f"must be a mapping of fields, not {_kind(value)}")
        return Fields(f"{self.where}: {name}", value)

    def sections(self, name: str) -> "list[Fields]":
        """Return a field that is a list of mappings; none where it is missing."""
        if name not in self:
            return []
        value = self.get(name)
        if not isinstance(value, list) or not all(isinstance(item, Mapping) for item in value):
            raise self.error(name, "must be a list of mappings ('- name: ...')")
        return [Fields(f"{self.where}: {name}[{i}]", item) for i, item in enumerate(value)]

    def allow(self, *names: str) -> None:
        """Raise a CalibrationError if there is a field of any other name."""
        for name in self.content:
            if name not in names:
                hint = nearest_name(name, names) or f" (known are {', '.join(names)})"
                raise CalibrationError(f"{self.where}: unknown field '{name}'{hint}")

    def error(self, name: str, problem: str) -> CalibrationError:
        """Return the error that says what is wrong with a field."""
        return CalibrationError(f"{self.where}: field '{name}' {problem}")

    def _number(self, name: str, value: Any) -> float:
        # YAML 1.1 reads 1e-4 (no point) as a text.
        if isinstance(value, str):
            try:
                value = float(value)
            except ValueError:
                raise self.error(name, f"must hold numbers, not '{value}'") from None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.error(name, f"must hold numbers, not {_kind(value)}")
        try:
            number = float(value)
        except OverflowError:
            number = float("inf")
        if not np.isfinite(number):
            raise self.error(name, f"must hold finite numbers, not {number}")
        return number

    def _se3(self, name: str, matrix: NDArray[np.float64]) -> SE3:
        rotation = matrix[:3, :3]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-9:
            raise self.error(name, "must end with the row 0, 0, 0, 1")
        if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise self.error(name, "is not a rigid transform: its 3x3 block is no rotation")
        if error < EXACT:
            return SE3.from_parts(rotation, matrix[:3, 3])  # what was written is read back exactly
        u, _, vt = np.linalg.svd(rotation)
        return SE3.from_parts(u @ vt, matrix[:3, 3])


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    return f"'{value}'"
