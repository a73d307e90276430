"""Ratios, ours over the peer's, against those written down before.

Milliseconds differ from machine to machine; the ratio of two programs in the same run differs
less. A baseline holds, per recording, the ratios of a quiet run, and per quantity by how much a
later ratio may exceed it before that is a regression:

    {"tolerance": {"ms_median": 0.2, ...}, "ratios": {"euroc_mh01": {"ms_median": 0.31, ...}}}
"""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from meter import machine

BASELINE = Path(__file__).parent / "baseline.json"

TOLERANCE = {
    "ate_m": 0.3,
    "ms_median": 0.2,
    "ms_p95": 0.25,
    "cpu_s": 0.2,
    "peak_memory_mb": 0.15,
    "seconds": 0.3,
}
"""What a new baseline starts with: the share by which a ratio may grow."""

Ratios = Mapping[str, Mapping[str, float]]


def ratios(ours: Mapping[str, float], peer: Mapping[str, float]) -> dict[str, float]:
    """Return ours / peer of every quantity with a tolerance; infinite where the peer has none."""
    return {
        name: ours[name] / peer[name] if peer[name] > 0 else math.inf
        for name in TOLERANCE
        if name in ours and name in peer
    }


def regressions(now: Ratios, baseline: Mapping[str, Any]) -> list[str]:
    """Return a sentence for every ratio that is worse than the baseline allows.

    What cannot be compared counts: a gate that has nothing to compare with must not open.
    """
    found = []
    tolerance = {**TOLERANCE, **baseline.get("tolerance", {})}
    for recording, values in now.items():
        before = baseline.get("ratios", {}).get(recording)
        if before is None:
            found.append(f"{recording}: not in the baseline: run with --update-baseline")
            continue
        for name, value in values.items():
            if name not in before:
                found.append(f"{recording}: {name}: not in the baseline")
                continue
            allowed = before[name] * (1 + tolerance[name])
            if not value <= allowed:  # so that NaN does not pass
                found.append(
                    f"{recording}: {name}: ratio {value:.3f}, baseline {before[name]:.3f},"
                    f" at most {allowed:.3f}"
                )
    return found


def read(path: Path) -> dict[str, Any]:
    """Read a baseline; an empty one if there is none yet."""
    if not path.exists():
        return {}
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content


def write(path: Path, now: Ratios, about: Mapping[str, Any]) -> None:
    """Write ratios over those of a baseline; all that is not written over stays."""
    before = read(path)
    rounded = {
        recording: {name: round(value, 4) for name, value in values.items()}
        for recording, values in now.items()
    }
    content = {
        **before,
        **about,
        "tolerance": before.get("tolerance", TOLERANCE),
        "ratios": {**before.get("ratios", {}), **rounded},
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what `verdict` acts on, and --json."""
    parser.add_argument("--json", help="write all numbers here")
    parser.add_argument("--gate", action="store_true", help="compare with the baseline")
    parser.add_argument("--update-baseline", action="store_true")


def verdict(
    options: argparse.Namespace,
    name: str,
    now: Ratios,
    missed: Sequence[str],
    path: Path = BASELINE,
) -> int:
    """Say what was missed or got worse, write a baseline if asked to; return the exit code.

    Args:
        options: with what `add_options` adds.
        name: of the benchmark, which has its own date and machine in the baseline.
        now: the ratios.
        missed: a sentence for every bar that is missed.
        path: of the baseline.
    """
    for line in missed:
        print(f"bar missed: {line}")
    if options.update_baseline:
        write(path, now, {name: {"date": date.today().isoformat(), "machine": machine()}})
        print(f"written: {path.name}")
    worse = regressions(now, read(path)) if options.gate else []
    for line in worse:
        print(f"regression: {line}")
    if options.gate:
        print("gate: closed" if worse or missed else "gate: open")
    return 1 if worse or missed else 0
