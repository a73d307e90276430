"""Map files: all that a map remembers in one file, read back exactly.

    save_map("map.odomap", map, rig)         map = load_map("map.odomap")

A map file is a zip of .npy arrays and a manifest in JSON (`mapschema`, docs/formats.md). A loaded
map is the saved one to the last bit, and goes on like it: the same ids for what comes next, the
same order of rows, and so the same numbers. Saved again it gives the same bytes.

A file is whole or not there: it is written beside its place, flushed and renamed. It is not
trusted: sizes are bounded before anything is read (`zipreader`), checksums, types and shapes are
compared, and then all ids and numbers (`mapchecks`); what does not fit is one `InputError`.
Opening reads the manifest only; `MapFile.features` reads those of one keyframe; `load_map` reads
all.

Reference: C. Cadena et al., "Past, present, and future of simultaneous localization and mapping",
IEEE Transactions on Robotics 32(6), 2016, section IV (maps that are kept).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from odomap.errors import InputError, OutputError
from odomap.files.atomic import atomic_binary
from odomap.files.fields import Fields
from odomap.files.mapchecks import Numbers, check_tables
from odomap.files.mapcolumns import (
    COUNTED,
    check_keypoints,
    columns_of,
    counts_of,
    tables_of,
)
from odomap.files.mapmanifest import VERSION, Manifest
from odomap.files.mappayloads import (
    add_payloads,
    checked_table,
    one_payload,
    payload_of,
    unpacked,
)
from odomap.files.mapschema import ARRAYS, PAYLOAD_TABLE, PAYLOADS
from odomap.files.records import plain
from odomap.files.rig import rig_fields, rig_of
from odomap.files.zipreader import FREE_BYTES, ZipReader
from odomap.files.zipwriter import ZipWriter
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.maps.tree import ABSENT, ALIVE
from odomap.sensors.rig import Rig
from odomap.version import __version__

if TYPE_CHECKING:
    from odomap.vision.features import Features

__all__ = ["SUFFIX", "VERSION", "MapFile", "load_map", "read_map_rig", "save_map"]

SUFFIX = ".odomap"


def save_map(
    path: str | Path,
    map: Map,
    rig: Rig | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Save a map; a file of that name stays as it was until the new one is whole.

    Args:
        path: the file, by custom ending in `.odomap`.
        map: what is remembered; its lock is held while its tables are copied.
        rig: the sensors it was made with.
        settings: what it was made with: numbers, texts, lists and mappings, kept as they are.

    Raises:
        OutputError: the operating system refuses; or the map could not be read back, since a pose
            or a measurement is not finite, or a payload is of a kind that is not kept.

    Example:
        >>> save_map("map.odomap", Map())  # doctest: +SKIP
    """
    file = Path(path)
    tables = map.dump()
    columns, kinds = columns_of(tables)
    numbers = Numbers(**{name: getattr(tables, name) for name in Numbers.__annotations__})
    try:
        size = sum(array.nbytes for array in columns.values())
        check_tables(columns, numbers, len(kinds), FREE_BYTES + size)
        check_keypoints(columns, tables.keyframes)
        with atomic_binary(file) as binary:
            writer = ZipWriter(binary)
            for name, kind in ARRAYS.items():
                writer.add(name, columns[name].astype(kind.kind, copy=False))
            add_payloads(writer, tables.keyframes)
            manifest = {
                "odomap_map": VERSION,
                "odomap": __version__,
                "counts": counts_of(columns),
                "numbers": plain(numbers),
                "edge_kinds": kinds,
                "rig": None if rig is None else rig_fields(rig),
                "settings": plain(dict(settings or {})),
                "arrays": writer.arrays,
            }
            writer.close(manifest)
    except (ValueError, TypeError, InputError) as error:
        raise OutputError(f"{file}: the map cannot be saved: {error}") from error


def load_map(path: str | Path, *, limit_mb: float = 4096.0) -> Map:
    """Load a map that goes on exactly as the saved one would have.

    Args:
        path: the file.
        limit_mb: how much its arrays may take together.

    Raises:
        InputError: it cannot be read, is broken, of a newer version, or cannot be true.
    """
    with MapFile(path, limit_mb=limit_mb) as file:
        return file.map()


def read_map_rig(path: str | Path) -> Rig | None:
    """Return the rig that a map was made with, or None where it is not said.

    Raises:
        InputError: see `load_map`.
    """
    with MapFile(path) as file:
        return file.rig


class MapFile:
    """A map file, opened; use it in a `with` block.

    Opening reads the directory and the manifest, some kilobytes, and makes sure that the arrays are
    there with the sizes declared. The rest is read when it is asked for.

    Attributes:
        path: the file.
        size: its bytes.
        version: of the format.
        counts: keyframes, stubs, landmarks, observations, edges, as the manifest says.
        arrays: type and shape of every array by name.
        odomap: version of odomap that wrote it.
        settings: what the map was made with.
        edge_kinds: what measured the edges.
    """

    def __init__(self, path: str | Path, *, limit_mb: float = 4096.0) -> None:
        """Open a map file.

        Args:
            path: the file.
            limit_mb: how much its arrays may take together.

        Raises:
            InputError: it cannot be read, is no map, or of a newer version.
        """
        self._zip = ZipReader(path, limit_mb)
        try:
            self.path, self.size = self._zip.path, self._zip.size
            manifest = Manifest(self._zip)
            self.version = manifest.version
            self.arrays = manifest.arrays()
            self.counts = manifest.integers("counts", COUNTED)
            self.edge_kinds = manifest.kinds()
            self.settings: dict[str, Any] = manifest.mapping("settings")
            self.odomap = str(manifest.content.get("odomap", ""))[:40]
            self.numbers = Numbers(**manifest.integers("numbers", tuple(Numbers.__annotations__)))
            self._rig = manifest.content.get("rig")
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._zip.close()

    @property
    def rig(self) -> Rig | None:
        """The rig that the map was made with, None where it is not said."""
        if self._rig is None:
            return None
        if not isinstance(self._rig, dict):
            raise self._zip.error("manifest.json: 'rig' must be a mapping")
        try:
            return rig_of(Fields(f"{self.path}: rig", self._rig))
        except (ValueError, TypeError, OverflowError) as error:
            raise self._zip.error(f"manifest.json: 'rig' cannot be: {error}") from error

    def array(self, name: str) -> NDArray[Any]:
        """Read one array, such as "states/Ts_world_body"; its checksum is compared.

        Raises:
            InputError: it is not there, or broken.
        """
        if name not in self.arrays:
            raise self._zip.error(f"{name}: there is no such array")
        kind = self.arrays[name]
        return self._zip.array(name, kind.kind, kind.shape, kind.crc32)

    def features(self, keyframe_id: int) -> "Features | None":
        """Read the features of one keyframe, without the rest of the map.

        Returns:
            None where it has none.

        Raises:
            InputError: what is there is broken.
        """
        parts = self._one("features", keyframe_id)
        features: Features | None = None if parts is None else payload_of("features", parts)
        return features

    def map(self) -> Map:
        """Read the whole map.

        Raises:
            InputError: it is broken, or cannot be true.
        """
        columns = {name: self.array(name) for name in ARRAYS if name in self.arrays}
        if self.version < 2:
            columns["landmarks/expected"] = columns["landmarks/seen"].copy()
        if self.version < 3:
            is_used = columns["tree/status"] != ABSENT
            columns["states/growths"] = np.where(
                is_used[:, None, None], np.full((6, 6), np.nan), 0.0
            )
        try:
            budget = FREE_BYTES + self.size
            check_tables(columns, self.numbers, len(self.edge_kinds), budget)
            if self.counts != counts_of(columns):
                raise ValueError(f"manifest.json: counts are not {counts_of(columns)}")
            keyframes = self._keyframes(columns)
            check_keypoints(columns, keyframes)
        except ValueError as error:
            raise self._zip.error(str(error)) from error
        return Map.restored(tables_of(columns, self.numbers, self.edge_kinds, keyframes))

    def _keyframes(self, columns: Mapping[str, NDArray[Any]]) -> tuple[Keyframe, ...]:
        status, stamps = columns["tree/status"], columns["keyframes/stamp_ns"]
        payloads: dict[int, dict[str, Any]] = {}
        for kind in PAYLOADS:
            if f"{kind}/keyframe" not in self.arrays:
                continue
            table = self._table(kind, status == ALIVE)
            for k, parts in unpacked(kind, table, self.array).items():
                payloads.setdefault(k, {})[kind] = payload_of(kind, parts)
        return tuple(
            Keyframe(k, int(stamps[k]), **payloads.get(k, {}))
            for k in np.flatnonzero(status == ALIVE).tolist()
        )

    def _table(self, kind: str, alive: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        table = {name: self.array(f"{kind}/{name}") for name in PAYLOAD_TABLE}
        shapes = {c.name: self.arrays[f"{kind}/{c.name}"].shape for c in PAYLOADS[kind]}
        checked_table(kind, table, alive, shapes)
        return table

    def _one(self, kind: str, keyframe_id: int) -> list[NDArray[Any]] | None:
        if f"{kind}/keyframe" not in self.arrays:
            return None
        try:
            table = self._table(kind, self.array("tree/status") == ALIVE)
            at = int(np.searchsorted(table["keyframe"], keyframe_id))
            if at == len(table["keyframe"]) or table["keyframe"][at] != keyframe_id:
                return None
            return one_payload(kind, table, at, self._rows)
        except ValueError as error:
            raise self._zip.error(str(error)) from error

    def _rows(self, name: str, first: int, end: int) -> NDArray[Any]:
        kind = self.arrays[name]
        return self._zip.rows(name, kind.kind, kind.shape, first, end)
