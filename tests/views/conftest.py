"""A synthetic run: a noisy path around a room, its estimates, and a procedural picture."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from odomap.geometry.lie import se3_adjoint, se3_exp, se3_inverse
from odomap.geometry.pose import SE3
from odomap.geometry.trajectory import Trajectory
from odomap.maps.estimate import Estimate, Status, Tracks
from odomap.viewing import View
from odomap.views.covisibility import MapView
from odomap.views.liveserver import close_server, open_server
from odomap.views.record import Growth, Report, Sample

START_NS = 1_403_636_579_763_555_584
PERIOD_NS = 50_000_000
STAGES = {"images": 1.5, "flow": 5.0, "pose": 0.8, "detect": 3.0, "stereo": 4.0, "bundle": 12.0}
SIGMA = np.array([0.8, 1.0, 0.7, 0.15, 0.2, 0.25]) * 1e-3


@cache
def paths(n: int) -> tuple[Trajectory, Trajectory]:
    """An odometry that drifts as it says, and the truth, which loops around a room."""
    rng = np.random.default_rng(0)
    s = np.linspace(0, 2.2 * np.pi, n)
    p = np.c_[3 * np.cos(s), 2 * np.sin(s), 0.7 * np.sin(2.5 * s) + 1.2]
    xi = np.c_[np.zeros((n, 3)), 0.15 * np.sin(3 * s), 0.1 * np.cos(2 * s), s + np.pi / 2]
    true = se3_exp(xi)
    true[:, :3, 3] = p
    steps = se3_inverse(true[:-1]) @ true[1:]
    adjoints = se3_adjoint(se3_inverse(steps))
    steps = steps @ se3_exp(rng.normal(0, SIGMA, (n - 1, 6)))
    noisy, P = [np.eye(4)], [np.zeros((6, 6))]
    for step, A in zip(steps, adjoints):
        noisy.append(noisy[-1] @ step)
        P.append(A @ P[-1] @ A.T + np.diag(SIGMA**2))
    stamps = START_NS + PERIOD_NS * np.arange(n, dtype=np.int64)
    return Trajectory(stamps, np.array(noisy), np.array(P)), Trajectory(stamps, true)


@cache
def picture(seed: int = 0, size: tuple[int, int] = (480, 752)) -> np.ndarray:
    """A room-like picture: a bright floor, darker walls, boxes, grain."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    grey = 90 + 50 * (v > 0.6 * size[0]) + 0.04 * u - 0.05 * v
    for _ in range(60):
        x, y = rng.uniform(0, size[1]), rng.uniform(0, size[0])
        w, h = rng.uniform(15, 110, 2)
        inside = (np.abs(u - x) < w / 2) & (np.abs(v - y) < h / 2)
        grey[inside] = rng.uniform(20, 230) + 0.1 * (u - x)[inside]
    return np.clip(grey + rng.normal(0, 3, size), 0, 255).astype(np.uint8)


def tracks(seed: int = 0, n: int = 280, size: tuple[int, int] = (480, 752)) -> Tracks:
    rng = np.random.default_rng(seed)
    now = rng.uniform((0, 0), (size[1], size[0]), (n, 2))
    flow = (now - np.array([size[1], size[0]]) / 2) * 0.04 + np.array([6.0, 1.0])
    inlier = rng.uniform(size=n) > 0.12
    flow[~inlier] += rng.normal(0, 14, (int((~inlier).sum()), 2))
    return Tracks(now.astype(np.float32), (now - flow).astype(np.float32), inlier)


def estimates(n: int, lost: range = range(0)) -> list[Estimate]:
    rng = np.random.default_rng(0)
    trajectory, _ = paths(n)
    assert trajectory.covariances is not None
    out = []
    wobble = rng.normal(0, 9, n)
    for k in range(n):
        keyframe = k % 7 == 0 and k not in lost
        timing = {
            stage: ms * rng.uniform(0.8, 1.4) * (keyframe or stage in ("images", "flow", "pose"))
            for stage, ms in STAGES.items()
        }
        status, reason, inliers = (
            Status.TRACKING,
            "",
            round(220 + 60 * np.sin(k / 9) + wobble[k]),
        )
        if k in lost:
            status, reason, inliers = Status.LOST, "9 inliers of 15 needed: motion blur?", 9
        elif lost and k == lost.stop:
            status = Status.RECOVERED
        pose = SE3(trajectory.Ts_world_body[k])
        out.append(
            Estimate(k, START_NS + PERIOD_NS * k, status, reason, k // 7, SE3.identity(), pose,
                     trajectory.covariances[k], inliers, keyframe, timing)
        )  # fmt: skip
    return out


def map_view(landmarks: np.ndarray, every: int = 5) -> MapView:
    """Keyframes along the path, of which those near each other share much."""
    trajectory, _ = paths(160)
    keyframes = trajectory.positions[::every]
    i, j = np.triu_indices(len(keyframes), 1)
    apart = np.linalg.norm(keyframes[i] - keyframes[j], axis=1)
    shared = np.round(260 * np.exp(-apart)).astype(np.int64)
    order = np.argsort(shared, kind="stable")
    kept = order[shared[order] >= 15]
    pairs = np.stack([i, j], axis=1)[kept]
    return MapView(keyframes, landmarks[::10], pairs, shared[kept], len(kept))


def growth(every: Sequence[Estimate]) -> Growth:
    """Half of a loop makes a map; in the other half one keyframe goes for each that comes."""
    n = len(every)
    k = np.arange(n)
    keyframes = np.minimum(np.cumsum([e.is_keyframe for e in every]), 12)
    memory = 300.0 + 40.0 * np.minimum(k[::10] / n, 0.5)
    return Growth(keyframes, 140 * keyframes, k[::10], memory)


def make_report(n: int = 160, lost: range = range(0), **changes: object) -> Report:
    trajectory, truth = paths(n)
    every = estimates(n, lost)
    kept = np.array([k for k in range(n) if k not in lost], dtype=int)
    rng = np.random.default_rng(5)
    walls = rng.uniform(-1, 1, (4000, 3)) * (5.0, 4.0, 1.5) + (0, 0, 1.5)
    side = rng.integers(0, 2, 4000)
    walls[np.arange(4000), side] = (
        np.sign(walls[np.arange(4000), side]) * np.array([5.0, 4.0])[side]
    )
    start = se3_inverse(truth.Ts_world_body[0])
    samples = []
    for k in np.linspace(0, n - 1, 4).astype(int):
        e = every[k]
        named = {f: getattr(e, f) for f in e.__dataclass_fields__}
        samples.append(Sample(picture(int(k)), Estimate(**{**named, "tracks": tracks(int(k))})))
    values: dict[str, object] = {
        "title": "room, seed 3",
        "source": "sim:room?seed=3",
        "version": "0.1.0",
        "command": "odomap run 'sim:room?seed=3' --out run",
        "config": "preset: stereo\nflow:\n  window_px: 11  # odd\n  levels: 4\n",
        "rig": "camera left: pinhole, 752x480, fx 458.65 fy 457.30 cx 367.22 cy 248.38",
        "estimates": every,
        "trajectory": trajectory.rows(kept),
        "truth": truth,
        "scores": {
            "ATE": {"matched": n, "rmse_m": 0.0134, "path_m": truth.path_length},
            "RPE 1 s": {"pairs": n - 20, "trans_rmse_m": 0.0071, "rot_rmse_deg": 0.05},
        },
        "metrics": {
            "frames": n, "tracked": n - len(lost), "lost": len(lost),
            "ms_per_frame": {"median": 9.31, "p95": 31.8}, "real_time_factor": 4.31,
            "keyframes": 23, "landmarks": 3120, "loops_closed": 0, "peak_memory_mb": 412.7,
        },
        "samples": samples,
        "points": walls @ start[:3, :3].T + start[:3, 3],
        "environment": {"Python": "3.11.9", "numpy": "2.4.6", "cores": "2"},
    }  # fmt: skip
    return Report(**{**values, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="session")
def report_of() -> Callable[..., Report]:
    """The function that makes synthetic reports."""
    return make_report


@pytest.fixture(scope="session")
def report() -> Report:
    """A run that tells of its map as well."""
    run = make_report(lost=range(61, 70))
    assert run.points is not None
    counts = {"landmarks_created": 15321, "keyframes_culled": 9}
    return replace(run, map=map_view(run.points), growth=growth(run.estimates), mapping=counts)


@pytest.fixture
def viser() -> object:
    """The server of pages, or a test that is skipped."""
    return pytest.importorskip("viser", reason="the live view needs viser")


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    """A server of pages, without a run."""
    pytest.importorskip("viser", reason="the live view needs viser")
    server, _ = open_server(port=8500)
    yield server
    close_server(server)


@pytest.fixture
def view(viser: object) -> Iterator[View]:
    """A page."""
    with View(port=8600) as view:
        yield view
