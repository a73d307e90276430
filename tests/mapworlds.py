"""Maps to be saved: small ones in which all that a map can hold occurs, and random ones."""

import numpy as np

from maps.test_map_properties import MapMachine, random_pose
from odomap.maps.keyframes import Keyframe
from odomap.maps.map import Map
from odomap.sensors.frame import ImuSamples
from odomap.vision.features import Features


def features(rng, count, width):
    bearings = rng.normal(size=(count, 3))
    return Features(
        rng.uniform(0, 640, (count, 2)).astype(np.float32),
        rng.integers(0, 256, (count, width), np.uint8),
        bearings / np.linalg.norm(bearings, axis=1, keepdims=True),
        np.where(rng.random(count) < 0.5, np.nan, rng.uniform(1, 9, count)),
        rng.integers(0, 8, count).astype(np.uint8),
    )


def rich_map(seed=0, keyframes=8):
    """Payloads of every kind, stubs, fused and removed landmarks, edges, and a reserved id."""
    rng = np.random.default_rng(seed)
    m = Map()
    for n in range(keyframes):
        imu = ImuSamples(np.arange(3) + 3 * n, rng.normal(size=(3, 3)), rng.normal(size=(3, 3)))
        keyframe = Keyframe(
            m.new_keyframe_id(),
            1_403_636_579_763_555_584 + 50_000_000 * n,
            features=None if n == 2 else features(rng, 20 + n, (32, 0, 128)[n % 3]),
            scan=np.array([1.0, np.nan, np.inf]) if n % 2 else None,
            cloud=rng.normal(size=(4, 3 + n % 2)).astype(np.float32) if n > 4 else None,
            imu=imu if n > 3 else None,
        )
        known = {"covariance": np.eye(6) * n, "v_world_body": rng.normal(size=3)} if n % 2 else {}
        m.add_keyframe(keyframe, random_pose(rng), scale=1.0 + 0.1 * (n % 3), **known)
        ids = m.add_landmarks(
            keyframe.id, rng.normal(size=(6, 3)), rng.integers(0, 256, (6, 32), np.uint8)
        )
        m.add_observations(keyframe.id, ids, np.arange(6))
        m.add_observations(keyframe.id, rng.integers(0, ids[-1] + 1, 6), np.arange(6, 12))
        m.count_seen(ids)
        m.count_expected(np.r_[ids, ids])
        if n:
            m.add_edge(n - 1, n, random_pose(rng), np.eye(6) * n, "odometry")
    m.states.biases[1] = 0.1
    m.add_edge(keyframes - 1, 0, random_pose(rng), np.eye(6), "loop", scale_i_j=1.5)
    m.fuse_landmarks([3, 9, 20], [9, 15, 21])
    m.remove_landmarks([1, 7, 30])
    m.cull_keyframes([0, 3])
    m.retire_keyframes([1])
    m.new_keyframe_id()
    return m


class Walk(MapMachine):
    """The state machine of the map, driven by a seed instead of hypothesis."""

    STEPS = (
        "add_keyframe",
        "add_landmarks",
        "observe",
        "expect_and_describe",
        "remove_observations",
        "remove_landmarks",
        "fuse",
        "cull",
        "retire",
        "snapshot",
        "apply",
    )

    def __init__(self, seed):
        super().__init__()
        self.choose = np.random.default_rng(seed)
        self.begin(seed)

    def go(self, steps):
        for _ in range(steps):
            name = self.STEPS[self.choose.integers(len(self.STEPS))]
            if (name == "cull" and len(self.model.S) < 3) or (name == "apply" and not self.pending):
                continue
            getattr(self, name)(int(self.choose.integers(1000)))


def same_map(a, b):
    """Assert that two maps hold the same to the last bit."""
    x, y = a.dump(), b.dump()
    assert x.columns.keys() == y.columns.keys()
    pairs = [(name, x.columns[name], y.columns[name]) for name in x.columns]
    for name in ("i", "j", "Ts_i_j", "scales_i_j", "information"):
        pairs.append((name, getattr(x.edges, name), getattr(y.edges, name)))
    assert len(x.keyframes) == len(y.keyframes)
    for j, k in zip(x.keyframes, y.keyframes):
        assert (j.id, j.stamp_ns) == (k.id, k.stamp_ns)
        for kind in ("features", "imu", "scan", "cloud"):
            u, v = getattr(j, kind), getattr(k, kind)
            assert (u is None) == (v is None), (j.id, kind)
            if isinstance(u, np.ndarray):
                pairs.append((kind, u, v))
            elif u is not None:
                pairs += [(f"{kind}/{n}", getattr(u, n), getattr(v, n)) for n in vars(u)]
    for name, u, v in pairs:
        assert u.dtype == v.dtype, name
        assert u.shape == v.shape, name
        assert u.tobytes() == v.tobytes(), name
    assert x.edges.kind == y.edges.kind
    for name in ("version", "epoch", "newest", "next_keyframe", "next_landmark"):
        assert getattr(x, name) == getattr(y, name), name
