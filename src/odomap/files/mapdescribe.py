"""What a map file holds, in words and numbers, without reading more of it than that takes.

Counts and sizes stand in the manifest, times and places in two small tables. Whether all of it is
whole and true is only known once everything was read.

Reference: C. Cadena et al., "Past, present, and future of simultaneous localization and mapping",
IEEE Transactions on Robotics 32(6), 2016.
"""

from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from odomap.errors import InputError
from odomap.files.mapfile import MapFile
from odomap.files.mapschema import PAYLOADS
from odomap.maps.tree import ALIVE
from odomap.sensors.rig import Rig

__all__ = ["describe_map", "map_lines"]


def describe_map(path: str | Path, *, check: bool = False) -> dict[str, Any]:
    """Return what a map file holds, as plain numbers and texts.

    Args:
        path: the file.
        check: whether to read all of it, which raises where something is broken.

    Raises:
        InputError: it is broken, or no map file.
    """
    with MapFile(path) as file:
        alive = file.array("tree/status") == ALIVE
        stamps = file.array("keyframes/stamp_ns")[alive]
        places = file.array("states/Ts_world_body")[alive, :3, 3]
        kinds = np.bincount(file.array("edges/kind").clip(min=0), minlength=len(file.edge_kinds))
        if check:
            file.map()
        if not (np.abs(places) < 1e100).all():
            raise InputError(f"{path}: states/Ts_world_body: a place is not finite")
        steps = np.linalg.norm(np.diff(places[np.argsort(stamps, kind="stable")], axis=0), axis=1)
        return {
            "file": str(path),
            "version": file.version,
            "odomap": file.odomap,
            "bytes": file.size,
            "checked": check,
            **file.counts,
            "edges_of_kind": {k: int(n) for k, n in zip(file.edge_kinds, kinds)},
            "payloads": _payloads(file),
            "first_stamp_ns": int(stamps.min()) if len(stamps) else None,
            "last_stamp_ns": int(stamps.max()) if len(stamps) else None,
            "path_units": round(float(steps.sum()), 6),
            "rig": _sensors(file.rig),
            "settings": file.settings,
        }


def _payloads(file: MapFile) -> dict[str, int]:
    """Return how many keyframes have each kind of payload."""
    tables = {kind: file.arrays.get(f"{kind}/keyframe") for kind in PAYLOADS}
    return {kind: table.shape[0] for kind, table in tables.items() if table is not None}


def _sensors(rig: Rig | None) -> list[str] | None:
    if rig is None:
        return None
    sensors = [f"camera {m.name}: {m.camera.model}" for m in rig.cameras]
    sensors += [f"depth on {rig.depth.camera}"] if rig.depth is not None else []
    sensors += ["imu"] if rig.imu is not None else []
    return sensors + [f"lidar {m.name}" for m in rig.lidars]


SETTINGS = MappingProxyType({"sensors": "made with"})
"""Settings of a map by other names, where theirs is that of another line."""


def map_lines(facts: dict[str, Any]) -> list[str]:
    """Return the facts as lines for people."""
    edges = ", ".join(f"{n} {kind}" for kind, n in facts["edges_of_kind"].items())
    payloads = ", ".join(f"{kind} of {n}" for kind, n in facts["payloads"].items())
    of_eyes = facts["landmarks"] > 0 or "cloud" not in facts["payloads"]
    rows = [
        ("keyframes", f"{facts['keyframes']}, and {facts['stubs']} culled ones"),
        ("payloads", payloads or "none"),
        *([("landmarks", f"{facts['landmarks']}, seen {facts['observations']} times")] * of_eyes),
        ("edges", f"{facts['edges']}" + (f" ({edges})" if edges else "")),
    ]
    if facts["first_stamp_ns"] is not None:
        span = 1e-9 * (facts["last_stamp_ns"] - facts["first_stamp_ns"])
        rows.append(("time", f"{span:.2f} s from {1e-9 * facts['first_stamp_ns']:.3f} s"))
    rows.append(("path", f"{facts['path_units']:.2f} along the keyframes"))
    rig = "not said" if facts["rig"] is None else "; ".join(facts["rig"])
    rows.append(("sensors", rig))
    said = {SETTINGS.get(name, name): str(value) for name, value in facts["settings"].items()}
    rows += [(name[:14], value) for name, value in said.items() if value]
    whole = "all of it was read and fits" if facts["checked"] else "--check reads all of it"
    rows.append(("file", f"{facts['bytes'] / 2**20:.2f} MB, by odomap {facts['odomap']}; {whole}"))
    head = f"{Path(facts['file']).name} (odomap map, version {facts['version']})"
    # A file from elsewhere may hold names that would drive a terminal.
    return [_printable(line) for line in [head, *(f"  {name:<14} {text}" for name, text in rows)]]


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)
