"""Registration of a real pair of clouds: odomap beside small_gicp and Open3D in one run.

    python benchmarks/registration.py [--repeats 7] [--starts 200] [--threads 1 2]

Errors are to the true motion, from the identity. Seconds are the smallest over the repeats, kernels
compiled before, of the processor with one thread, of wall time with several: of the whole
(down-sampling, normals, search structures, alignment) and of the alignment of clouds made ready.
Ours is timed before and after the peers. Random starts lie up to 1 m and 20° from the truth; one
has converged within 5 cm and 0.5°.

The exit code is 1 where a bar is missed: GICP's error at most small_gicp's, or 2 cm and 0.2°; its
time at most small_gicp's with as many threads, whole and alone; the share of starts that converge
at least the best peer's.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gate
import numpy as np
import peer
from meter import machine

import odomap
from odomap.geometry.lie import orthonormalize, se3_exp, so3_log
from odomap.lidar.cloud import Cloud
from odomap.lidar.target import Target, sample

HERE = Path(__file__).parent
PEERS = ("small_gicp", "open3d")
NEAR_M, NEAR_DEG = 0.05, 0.5
BAR_M, BAR_DEG = 0.02, 0.2
VOXEL, REACH = 0.25, 1.0


@dataclass(frozen=True)
class Row:
    """One method of one library with so many threads.

    Attributes:
        who: the library.
        method: its method.
        threads: how many it used.
        whole_s: seconds with all that is made ready.
        align_s: seconds of the alignment alone.
        error_m: from the identity.
        error_deg: likewise.
        share: of random starts that converged.
    """

    who: str
    method: str
    threads: int
    whole_s: float
    align_s: float
    error_m: float
    error_deg: float
    share: float


def errors(truth: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return metres (N,) and degrees (N,) of motions (N, 4, 4) off the true one."""
    off = np.linalg.inv(truth) @ found
    turned = so3_log(orthonormalize(off[:, :3, :3]))
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(np.linalg.norm(turned, axis=1))


def random_starts(truth: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Return (N, 4, 4) up to 1 m and 20° from the truth, evenly in distance and angle."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(2, count, 3))
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    T = se3_exp(
        np.hstack([np.zeros((count, 3)), axes[1] * rng.uniform(0, np.radians(20), (count, 1))])
    )
    T[:, :3, 3] = axes[0] * rng.uniform(0, 1, (count, 1))
    return np.asarray(truth @ T)


def read_pair(folder: Path) -> dict[str, Any]:
    truth = np.loadtxt(folder / "T_target_source.txt")
    truth[:3, :3] = orthonormalize(truth[:3, :3])
    clouds = {
        n: np.float64(odomap.read_ply(folder / f"{n}.ply").points) for n in ("source", "target")
    }
    return {**clouds, "truth": truth, "voxel": VOXEL, "reach": REACH}


def ours(pair: dict[str, Any], method: str, threads: int, repeats: int) -> dict[str, float]:
    """Return our seconds, the smallest over repeats."""
    given = {"threads": threads, "voxel": VOXEL, "max_distance": REACH}
    odomap.register(pair["source"], pair["target"], method, **given)
    ready = Target.of(pair["target"], VOXEL, REACH)
    sampled = sample(Cloud.of(pair["source"]), VOXEL, 10, "source")
    clock = time.process_time if threads == 1 else time.perf_counter
    whole, alone = [], []
    for _ in range(repeats):
        begin = clock()
        odomap.register(pair["source"], pair["target"], method, **given)
        middle = clock()
        odomap.register(sampled, ready, method, **given)
        alone.append(clock() - middle)
        whole.append(middle - begin)
    return {"whole_s": min(whole), "align_s": min(alone)}


def our_ends(pair: dict[str, Any], method: str) -> np.ndarray:
    """Return where ours ends: from the identity, then from each start."""
    ready = Target.of(pair["target"], VOXEL, REACH)
    sampled = sample(Cloud.of(pair["source"]), VOXEL, 10, "source")
    starts = [np.eye(4), *pair["starts"]]
    return np.stack(
        [odomap.register(sampled, ready, method, initial=T).T_target_source for T in starts]
    )


def of_peer(
    options: argparse.Namespace, name: str, threads: int, given: Path, scratch: Path
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Have a peer do it in its own process; return seconds and ends by method."""
    out = scratch / f"{name}_{threads}.npz"
    command = [options.peer_python, str(HERE / "registration_peers.py"), name, str(given), str(out)]
    command += ["--threads", str(threads), "--repeats", str(options.repeats)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not out.exists():
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        sys.exit(f"{name} failed: {lines[-1]}")
    with np.load(out) as arrays:
        about = json.loads(str(arrays["about"]))
        return about, {method: np.array(arrays[method]) for method in about}


def compare(options: argparse.Namespace, pair: dict[str, Any], scratch: Path) -> list[Row]:
    """Return a row for each method, library and number of threads."""
    given = scratch / "pair.npz"
    np.savez(given, **pair)
    rows = []
    ends = {method: our_ends(pair, method) for method in options.methods}
    for threads in options.threads:
        before = {m: ours(pair, m, threads, options.repeats) for m in options.methods}
        for name in options.peers:
            about, theirs = of_peer(options, name, threads, given, scratch)
            rows += [row(name, m, threads, about[m], theirs[m], pair["truth"]) for m in about]
        for m in options.methods:
            again = ours(pair, m, threads, options.repeats)
            times = {key: min(before[m][key], again[key]) for key in again}
            rows.append(row("odomap", m, threads, times, ends[m], pair["truth"]))
    return rows


def row(
    who: str,
    method: str,
    threads: int,
    times: dict[str, float],
    ends: np.ndarray,
    truth: np.ndarray,
) -> Row:
    metres, degrees = errors(truth, ends)
    good = (metres[1:] < NEAR_M) & (degrees[1:] < NEAR_DEG)
    share = float(good.mean()) if len(good) else float("nan")
    first = float(metres[0]), float(degrees[0])
    return Row(who, method, threads, times["whole_s"], times["align_s"], *first, share)


def below_bars(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for every bar that is missed."""
    missed = []
    for mine in (r for r in rows if r.who == "odomap" and r.method == "gicp"):
        others = [r for r in rows if r.who != "odomap" and r.threads == mine.threads]
        rivals = [r for r in others if r.who == "small_gicp" and r.method == "gicp"]
        for them in rivals:
            for name in ("whole_s", "align_s"):
                ratio = getattr(mine, name) / getattr(them, name)
                if not ratio <= 1.0:
                    missed.append(
                        f"gicp, {mine.threads} threads: {ratio:.2f} of the {name}, at most 1"
                    )
        if not mine.error_m <= max([BAR_M, *(r.error_m for r in rivals)]):
            missed.append(f"gicp: {mine.error_m:.4f} m off")
        if not mine.error_deg <= max([BAR_DEG, *(r.error_deg for r in rivals)]):
            missed.append(f"gicp: {mine.error_deg:.3f}° off")
        best = max((r.share for r in others), default=0.0)
        if mine.share < best:
            missed.append(f"gicp: {mine.share:.1%} of starts converge, {best:.1%} of a peer's")
    return missed


def ratios(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Return our seconds over those of small_gicp, for the gate."""
    times = {(r.who, r.method, r.threads): r.whole_s for r in rows}
    return {
        f"registration/{method}/{threads}": {
            "seconds": times["odomap", method, threads] / seconds
        }
        for (who, method, threads), seconds in times.items()
        if who == "small_gicp" and ("odomap", method, threads) in times
    }  # fmt: skip


def table(rows: Sequence[Row]) -> str:
    lines = [
        f"{'':12}{'method':8}{'threads':>8}{'whole ms':>10}{'align ms':>10}{'error mm':>10}"
        f"{'deg':>7}{'converge':>10}"
    ]
    for r in sorted(rows, key=lambda r: (r.threads, r.method, r.who)):
        lines.append(
            f"{r.who:12}{r.method:8}{r.threads:8}{1e3 * r.whole_s:10.1f}{1e3 * r.align_s:10.1f}"
            f"{1e3 * r.error_m:10.1f}{r.error_deg:7.3f}{r.share:10.1%}"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    env = os.environ.get
    parser.add_argument("--data", default=env("ODOMAP_DATA"), help="folder with registration/")
    parser.add_argument("--peer-python", default=env("ODOMAP_PEER_PYTHON", sys.executable))
    parser.add_argument("--peers", nargs="*", choices=PEERS, default=list(PEERS))
    parser.add_argument("--methods", nargs="+", default=["gicp", "plane", "icp"])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--starts", type=int, default=200)
    gate.add_options(parser)
    options = parser.parse_args()
    peer.require(parser, options, ("data",))
    pair = read_pair(Path(options.data) / "registration")
    pair["starts"] = random_starts(pair["truth"], options.starts)
    with tempfile.TemporaryDirectory(prefix="odomap-registration-") as folder:
        rows = compare(options, pair, Path(folder))
    print(f"{machine()}; smallest of {options.repeats} runs, voxel {VOXEL} m, reach {REACH} m")
    print(table(rows))
    if options.json:
        Path(options.json).write_text(
            json.dumps({"machine": machine(), "rows": [vars(r) for r in rows]}, indent=1), "utf-8"
        )
    return gate.verdict(options, "registration", ratios(rows), below_bars(rows))


if __name__ == "__main__":
    sys.exit(main())
