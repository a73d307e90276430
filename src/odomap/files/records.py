"""Records: metrics and settings as JSON and YAML that a diff can compare.

The same content gives the same bytes: keys stay in the order they were put in, floats are written
with the fewest digits that read back to the same number, and what JSON cannot hold (NaN,
infinity) becomes null. NumPy scalars and arrays are written as numbers and lists.
"""

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from odomap.errors import InputError
from odomap.files.atomic import write_text
from odomap.files.text import read_text

__all__ = ["plain", "read_json", "write_json", "write_yaml"]


def plain(value: Any) -> Any:
    """Return a value as plain numbers, texts, lists and mappings.

    Args:
        value: mappings, sequences, dataclasses, NumPy arrays and scalars, enums and paths, nested.

    Raises:
        TypeError: something has no plain form.
    """
    if value is None or (isinstance(value, (bool, str)) and not isinstance(value, Enum)):
        return value
    if isinstance(value, Enum):
        return plain(value.value)
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    raise TypeError(f"{type(value).__name__} has no plain form")


def write_json(path: str | Path, content: Any) -> None:
    """Write JSON, indented, in the order given.

    Raises:
        OutputError: it cannot be written.
    """
    write_text(
        path, json.dumps(plain(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    )


def read_json(path: str | Path, packed: bool = True) -> Any:
    """Read JSON.

    Args:
        path: the file.
        packed: whether gzip is unpacked, which may be much larger than the file.

    Raises:
        InputError: it cannot be read, or is not JSON.
    """
    try:
        return json.loads(read_text(Path(path), packed))
    except json.JSONDecodeError as error:
        is_cut = error.pos >= len(error.doc.rstrip()) or error.msg.startswith("Unterminated")
        why = f"{error.msg}{' (is it cut short?)' if is_cut else ''}"
        raise InputError(f"{path}:{error.lineno}: not valid JSON: {why}") from error
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, nested lists
        raise InputError(f"{path}: not valid JSON: nobody writes such numbers or lists") from error


def write_yaml(path: str | Path, content: Any) -> None:
    """Write YAML in the order given.

    Raises:
        OutputError: it cannot be written.
    """
    text = yaml.safe_dump(
        plain(content), sort_keys=False, default_flow_style=None, allow_unicode=True, width=100
    )
    write_text(path, text)
