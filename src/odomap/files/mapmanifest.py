"""The manifest of a map file: which version, which arrays, and the numbers beside them.

    {"odomap_map": 3, "odomap": "0.6", "counts": {...}, "numbers": {...}, "edge_kinds": [...],
     "rig": {...} or null, "settings": {...},
     "arrays": {"states/scales": {"dtype": "<f8", "shape": [120], "crc32": 305419896}, ...}}

Every array of the version has to be declared, with its own type; lengths that have one name must be
one number, and each member must be as large as its declaration takes. All that is known before an
array is read.

Reference: ECMA-404, "The JSON data interchange syntax", 2nd ed., 2017.
"""

from typing import Any

from odomap.errors import InputError
from odomap.files.mapschema import ARRAYS, PAYLOAD_TABLE, PAYLOADS, Array, Declared
from odomap.files.ziplayout import MANIFEST
from odomap.files.zipreader import ZipReader

__all__ = ["VERSION", "Manifest"]

VERSION = 3
MOST_KINDS = 256
LONGEST_KIND = 64
LONGEST = 1 << 31


class Manifest:
    """The manifest of a map file, field by field.

    Attributes:
        content: all of it, plain JSON.
        version: of the format.
    """

    def __init__(self, file: ZipReader) -> None:
        """Look at the version.

        Raises:
            InputError: it is none, or a newer one.
        """
        self._file = file
        self.content = file.manifest
        version = self.content.get("odomap_map")
        if type(version) is not int or version < 1:
            raise file.error(f"is no map file: {MANIFEST} has no version 'odomap_map'")
        if version > VERSION:
            raise file.error(
                f"is of version {version}, this odomap reads {VERSION}: it was written by a newer "
                "odomap, update this one"
            )
        self.version: int = version

    def mapping(self, name: str) -> dict[str, Any]:
        """Return a field that is a mapping."""
        value = self.content.get(name)
        if not isinstance(value, dict):
            raise self._error(name, "must be a mapping")
        return value

    def integers(self, name: str, fields: tuple[str, ...]) -> dict[str, int]:
        """Return a field that maps just these names to whole numbers."""
        value = self.mapping(name)
        if set(value) != set(fields) or any(type(n) is not int for n in value.values()):
            raise self._error(name, f"must have the whole numbers {', '.join(fields)}")
        return {field: value[field] for field in fields}

    def kinds(self) -> tuple[str, ...]:
        """Return the names of the kinds of edges."""
        value = self.content.get("edge_kinds")
        if not isinstance(value, list) or len(value) > MOST_KINDS:
            raise self._error("edge_kinds", f"must be a list of at most {MOST_KINDS} names")
        if any(type(kind) is not str or len(kind) > LONGEST_KIND for kind in value):
            raise self._error("edge_kinds", f"must be names of at most {LONGEST_KIND} letters")
        if len(set(value)) != len(value):
            raise self._error("edge_kinds", "names a kind twice")
        return tuple(value)

    def arrays(self) -> dict[str, Declared]:
        """Return type and shape of every array, all of them there and of the right size."""
        wanted = self._wanted()
        declared = self.mapping("arrays")
        members = {name.removesuffix(".npy") for name in self._file.members}
        for name in sorted({*members, *declared} - set(wanted)):
            raise self._file.error(f"{name[:80]!r}: is no part of a map of version {self.version}")
        lengths: dict[str, int] = {}
        found: dict[str, Declared] = {}
        for name, kind in wanted.items():
            entry = self._declared(name, kind.kind, declared.get(name))
            group = name.split("/", maxsplit=1)[0] if name not in ARRAYS else ""
            letters = [f"{group}{n}" if isinstance(n, str) else n for n in kind.shape]
            fits = len(entry.shape) == len(letters) and all(
                n == (lengths.setdefault(letter, n) if isinstance(letter, str) else letter)
                for n, letter in zip(entry.shape, letters)
            )
            if not fits:
                raise self._error(name, f"has shape {entry.shape}: lengths do not match")
            self._file.check_array(name, entry.kind, entry.shape)
            found[name] = entry
        return found

    def _wanted(self) -> dict[str, Array]:
        """Return the arrays that have to be there: those of payloads where one of them is."""
        wanted = {name: array for name, array in ARRAYS.items() if array.since <= self.version}
        for kind, columns in PAYLOADS.items():
            if any(name.startswith(f"{kind}/") for name in self._file.members):
                wanted |= {f"{kind}/{name}": array for name, array in PAYLOAD_TABLE.items()}
                wanted |= {f"{kind}/{column.name}": column.array for column in columns}
        return wanted

    def _declared(self, name: str, kind: str, entry: Any) -> Declared:
        """Return what is declared of an array."""
        if not isinstance(entry, dict):
            raise self._error(name, "is not declared")
        if entry.get("dtype") != kind:
            raise self._error(name, f"must be of type {kind}, not {str(entry.get('dtype'))[:40]!r}")
        shape, crc = entry.get("shape"), entry.get("crc32")
        if not isinstance(shape, list) or type(crc) is not int:
            raise self._error(name, "must have a shape and a crc32")
        if any(type(n) is not int or not 0 <= n < LONGEST for n in shape):
            raise self._error(name, "has a shape that cannot be")
        return Declared(kind, tuple(shape), crc)

    def _error(self, field: str, problem: str) -> InputError:
        return self._file.error(f"{MANIFEST}: {field} {problem}")
