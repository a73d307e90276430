"""Settings as text: a `Config` written as YAML that explains itself, and read back with care.

Every section of a config is a frozen dataclass with a docstring under each field. Writing turns
those docstrings into comments; reading checks names (the nearest one is suggested), types and, by
making the dataclasses anew, ranges (`odomap.limits`). One path serves files and command-line
overrides, so both give the same errors. Works on any tree of dataclasses: sections added later need
nothing here.
"""

import ast
import contextlib
import dataclasses
import enum
import functools
import inspect
import itertools
import math
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from odomap.errors import ConfigError, nearest_name

__all__ = ["config_to_yaml", "field_docs", "override", "read_config", "updated"]

T = TypeVar("T")

HEADER = (
    "odomap_config",
    "odomap",
    "preset",
    "data",
    "rig",
    "rhythm",
    "max_frames",
    "command",
    "map",
    "is_mapping",
)
"""Top-level keys of a config.yaml that say where it comes from; reading skips them."""


def field_docs(section: type) -> dict[str, str]:
    """Return the docstring under each field of a dataclass, on one line.

    Args:
        section: a dataclass type whose source can be read.

    Returns:
        Field name → text; fields without a docstring are absent.
    """
    return dict(_field_docs(section))


@functools.cache
def _field_docs(section: type) -> Mapping[str, str]:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(section)))
    except (OSError, TypeError):
        return {}
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    docs: dict[str, str] = {}
    for field, text in itertools.pairwise(body):
        if (
            isinstance(field, ast.AnnAssign)
            and isinstance(field.target, ast.Name)
            and isinstance(text, ast.Expr)
            and isinstance(text.value, ast.Constant)
            and isinstance(text.value.value, str)
        ):
            docs[field.target.id] = " ".join(text.value.value.split())
    return docs


def config_to_yaml(config: object, header: Mapping[str, object] | None = None) -> str:
    """Write a config as YAML with each field's docstring above it.

    Args:
        config: a dataclass, nested at will.
        header: keys to put first, such as the source and the version.

    Returns:
        Text that `read_config` reads back to an equal config.
    """
    lines = ["odomap_config: 1"]
    lines += [f"{key}: {_scalar(value)}" for key, value in (header or {}).items()]
    lines += _section_lines(config, 0)
    return "\n".join(lines) + "\n"


def _section_lines(section: object, depth: int) -> Iterator[str]:
    indent = "  " * depth
    docs = field_docs(type(section))
    for field in dataclasses.fields(section):  # type: ignore[arg-type]
        value = getattr(section, field.name)
        if dataclasses.is_dataclass(value):
            yield ""
            doc = docs.get(field.name) or (inspect.getdoc(value) or "").split("\n")[0]
            yield from _comment(doc, indent)
            yield f"{indent}{field.name}:"
            yield from _section_lines(value, depth + 1)
        else:
            yield from _comment(docs.get(field.name, ""), indent)
            yield f"{indent}{field.name}: {_scalar(value)}"


def _comment(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, 96, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _scalar(value: object) -> str:
    import yaml

    if isinstance(value, enum.Enum):
        value = value.value
    if isinstance(value, tuple):
        value = list(value)
    if isinstance(value, Path):
        value = str(value)
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...").strip()


def read_config(path: str | Path, base: T) -> T:
    """Read a config file over a base config; what the file does not say stays as it is there.

    Args:
        path: YAML as `odomap config` prints it or a run writes it.
        base: the config to start from.

    Returns:
        A new config of the same type.

    Raises:
        ConfigError: the file is missing or not YAML, or a section, field or value is wrong.
    """
    import yaml

    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file (byte {error.start})") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1}: " if mark else ""
        raise ConfigError(f"{path}: {line}not YAML: {getattr(error, 'problem', error)}") from error
    if content is None:
        return base
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected 'section:' lines, as `odomap config` prints them")
    version = content.get("odomap_config", 1)
    if version != 1:
        raise ConfigError(f"{path}: field 'odomap_config' is {version}, this odomap reads 1")
    known = {field.name for field in dataclasses.fields(base)}  # type: ignore[arg-type]
    sections = {k: v for k, v in content.items() if k in known or k not in HEADER}
    return updated(base, sections, str(path))


def override(config: T, assignments: Sequence[tuple[str, str]]) -> T:
    """Change single fields of a config, as the command line gives them.

    Args:
        config: the config to start from.
        assignments: pairs such as ``("tracking.min_inliers", "20")``; values are read as YAML.

    Returns:
        A new config.

    Raises:
        ConfigError: a name or a value is wrong.
    """
    import yaml

    changes: dict[str, object] = {}
    for dotted, text in assignments:
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"--{dotted}: cannot read the value {text!r}") from error
        nested: object = value
        for name in reversed(dotted.split(".")):
            nested = {name: nested}
        assert isinstance(nested, dict)
        changes = _merged(changes, nested)
    # All at once: of two fields that bound each other, the first alone may not fit the other.
    return updated(config, changes, "command line")


def _merged(first: Mapping[str, object], then: Mapping[str, object]) -> dict[str, object]:
    """Return both mappings in one, nested ones too; where they disagree, the later counts."""
    merged = dict(first)
    for name, value in then.items():
        before = merged.get(name, value)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            value = _merged(before, value)
        elif isinstance(before, Mapping) or isinstance(value, Mapping):
            raise ConfigError(f"command line: '{name}' is given as a value and as a section")
        merged[name] = value
    return merged


def updated(section: T, values: Mapping[Any, object], where: str, path: str = "") -> T:
    """Return a copy of a dataclass with some fields changed, each checked against its type.

    Args:
        section: the dataclass to start from.
        values: field name → value; a nested mapping changes a nested section.
        where: file name for error messages.
        path: dotted name of this section for error messages.

    Raises:
        ConfigError: an unknown name, a value of the wrong type or outside its range.
    """
    fields = [field.name for field in dataclasses.fields(section)]  # type: ignore[arg-type]
    hints = typing.get_type_hints(type(section))
    changes: dict[str, object] = {}
    for name, value in values.items():
        dotted = f"{path}{name}"
        if name not in fields:
            raise ConfigError(_unknown(where, dotted, str(name), fields))
        current = getattr(section, name)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: '{dotted}' is a section: give its fields below it")
            changes[name] = updated(current, value, where, f"{dotted}.")
        else:
            changes[name] = _converted(value, hints[name], f"{where}: field '{dotted}'")
    try:
        return dataclasses.replace(section, **changes)  # type: ignore[type-var]
    except ConfigError as error:
        raise ConfigError(f"{where}: {path}{error}") from error
    except ValueError as error:
        raise ConfigError(f"{where}: section '{path.rstrip('.')}': {error}") from error


def _unknown(where: str, dotted: str, name: str, known: Iterable[str]) -> str:
    hint = nearest_name(name, known) or f" (known: {', '.join(sorted(known))})"
    return f"{where}: unknown field '{dotted}'{hint}"


def _converted(value: object, hint: Any, what: str) -> object:
    """Return a value as the type of its field, or raise ConfigError that says what was expected."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        if value in options:
            return value
        near = nearest_name(str(value), map(str, options))
        choices = ", ".join(map(str, options))
        raise ConfigError(f"{what} is {value!r}, one of {choices} expected{near}")
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        return _converted(value, next(o for o in options if o is not type(None)), what)
    if origin is tuple and isinstance(value, list | tuple):
        if len(options) == 2 and options[1] is Ellipsis:
            return tuple(_converted(v, options[0], what) for v in value)
        if len(value) == len(options):
            return tuple(_converted(v, o, what) for v, o in zip(value, options))
        raise ConfigError(f"{what} has {len(value)} values, {len(options)} expected")
    return _plain(value, hint, what)


def _plain(value: object, hint: Any, what: str) -> object:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if isinstance(value, float) and math.isnan(value):
        raise ConfigError(f"{what} is not a number")
    if hint is float and is_number:
        return float(typing.cast(float, value))
    if hint is float and isinstance(value, str):
        with contextlib.suppress(ValueError):  # YAML 1.1 reads 1e-5, without a point, as text
            return float(value)
    if hint is int and is_number and float(typing.cast(float, value)).is_integer():
        return int(typing.cast(float, value))
    if hint in (bool, str) and isinstance(value, hint):
        return value
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        if value in [member.value for member in hint]:
            return hint(value)
        choices = ", ".join(str(member.value) for member in hint)
        raise ConfigError(f"{what} is {value!r}, one of {choices} expected")
    if hint is Path and isinstance(value, str):
        return Path(value)
    if not isinstance(hint, type) or hint in (bool, str, int, float, Path):
        name = {bool: "true or false", str: "text", int: "a whole number", float: "a number"}
        raise ConfigError(f"{what} is {value!r}, {name.get(hint, str(hint))} expected")
    return value
