"""Where is the camera? The search for map points and the pose from them, in NumPy.

Run it with `python examples/20_track_by_hand.py`; docs/lesson/03_orb_slam.md explains it.
"""

import numpy as np

from odomap import SE3, Camera, Slam, open
from odomap.vision.orb import OrbConfig, OrbFeatures, extract


def search(views, T: SE3, camera: Camera, found: OrbFeatures, radius: float) -> np.ndarray:
    """Return (n, 2): which map point is which feature, if the camera is at T_world_camera."""
    pairs, p = [], T.inverse() @ views.points_world
    away, pixels = np.linalg.norm(p, axis=1), camera.project(p)
    level = views.level + np.log(views.distance / away) / np.log(1.2)  # nearer is larger
    facing = np.sum(views.normals @ T.R * p, axis=1) > 0.5 * away  # within 60 degrees
    for i in np.flatnonzero((p[:, 2] > 0) & camera.is_inside(pixels) & facing):
        close = np.hypot(*(found.keypoints - pixels[i]).T) < radius * 1.2 ** level[i]
        near = np.flatnonzero(close & (np.abs(found.level - level[i]) < 1.5))
        bits = np.unpackbits(found.descriptors[near] ^ views.descriptors[i], axis=1).sum(axis=1)
        pairs += [(i, near[bits.argmin()])] if bits.min(initial=256) < 64 else []
    return np.array(pairs)


def refine(T: SE3, points: np.ndarray, pixels: np.ndarray, sigma: np.ndarray, f: float) -> SE3:
    """Return the pose that agrees best: Gauss-Newton, Huber's weights; pixels from the centre."""
    for _ in range(10):
        x, y, z = (T.inverse() @ points).T
        r, none = (f * np.stack([x / z, y / z], axis=1) - pixels) / sigma[:, None], 0.0 * z
        by_p = np.array([[f / z, none, -f * x / z**2], [none, f / z, -f * y / z**2]]) / sigma
        turned = np.array([[none, -z, y], [z, none, -x], [-y, x, none]])  # [p]x
        J = np.concatenate([-by_p, np.einsum("abn,bcn->acn", by_p, turned)], axis=1)
        w = np.minimum(1.0, 2.5 / np.linalg.norm(r, axis=1))
        H, g = np.einsum("ain,ajn,n->ij", J, J, w), np.einsum("ain,na,n->i", J, r, w)
        T = T @ SE3.exp(-np.linalg.solve(H, g))
    return T


def main() -> None:
    source = open("sim:room?seed=4&frames=10&sensors=mono,depth&speed=3")
    *before, last = source
    system, camera = Slam(source.rig), source.rig.cameras[0].camera
    poses = [("as the frame before", [system.track(f).T_world_body for f in before][-1], 0)]
    views = system.map.views_of(system.map.landmark_ids, np.eye(4))
    found = extract(last.images[0], OrbConfig())
    pixels, sigma = found.keypoints - (camera.cx, camera.cy), 1.2 ** found.level.astype(float)
    for radius in (24.0, 12.0, 4.0):
        i, k = search(views, T := poses[-1][1], camera, found, radius).T
        T = refine(T, views.points_world[i], pixels[k], sigma[k], camera.fx)
        poses.append((f"searched {radius:2.0f} px around", T, len(i)))
    poses.append(("odomap", (estimate := system.track(last)).T_world_body, estimate.num_inliers))
    true = source.truth.pose(0).inverse() @ source.truth.pose(len(before))
    for name, T, count in poses:
        print(f"{name:21}: {count:3} points, off by {1000 * np.linalg.norm(T.t - true.t):5.1f} mm")


if __name__ == "__main__":
    main()
