"""Runs of solvers, each in a process of its own, on one core and in one thread."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from graph_peers import THREADS

HERE = Path(__file__).parent

Outcome = tuple[dict[str, Any], list[np.ndarray]]
"""What a solver's process wrote: about its runs, and where each configuration ended."""


def outcome(command: list[str], options: list[str], scratch: Path) -> Outcome:
    """Run a solver's process, its numeric libraries in one thread; read what it wrote."""
    out = scratch / "out.npz"
    out.unlink(missing_ok=True)
    env = os.environ | dict.fromkeys(THREADS, "1")
    done = subprocess.run(
        [*command, str(out), *options], env=env, capture_output=True, text=True, check=False
    )
    if done.returncode != 0 or not out.exists():
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        sys.exit(f"{' '.join(command[:3])} failed: {lines[-1]}")
    with np.load(out) as arrays:
        about = json.loads(str(arrays["about"]))
        return about, [arrays[f"poses_{n}"] for n in range(len(about["runs"]))]


def last_core() -> int:
    return max(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else -1


def merged(several: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what several processes of one solver said; of seconds, the smallest."""
    said = {key: value for each in several for key, value in each.items()}
    for key in said:
        if key.endswith("_s"):
            said[key] = min(each[key] for each in several)
    return said
