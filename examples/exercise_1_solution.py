"""Exercise 1, solved: monocular visual odometry from scratch (docs/lesson/exercise_1.md).

    python examples/exercise_1_solution.py                          # a simulated room
    python examples/exercise_1_solution.py "sim:street?seed=1&frames=80&sensors=mono" street.png
    python examples/exercise_1_solution.py kitti/sequences/03 path.png

Detect corners, follow them, start from an essential matrix, then place every frame by the landmarks
(PnP) and make new landmarks from old tracks, so that the scale of the start is handed on.
"""

import sys
from dataclasses import dataclass

import cv2
import numpy as np

import odomap
from odomap.geometry.pnp import solve_pnp
from odomap.geometry.pose import SE3
from odomap.geometry.triangulate import triangulate

DATA = "sim:room?seed=0&frames=100&sensors=mono"
CORNERS = 400  # wanted in an image
SPACING = 12  # pixels between two of them
START_TRACKS = 50  # needed to start
START_PARALLAX = 2.0  # degrees: the median of the two views we start from
POINT_PARALLAX = 1.5  # degrees: less, and a track is a direction, not yet a point
ERROR_PX = 2.0  # an observation farther off than this is wrong
VIEWS = 8  # keyframes remembered


@dataclass
class Tracks:
    """What is being followed. Column j of every array is track j.

    `views` holds where each of the last keyframes saw it, as x/z, y/z; NaN where it did not.
    """

    pixels: np.ndarray  # (N, 2) where each is in the newest image
    points: np.ndarray  # (N, 3) its landmark in the world, NaN while it has none
    views: np.ndarray  # (V, N, 2)

    def keep(self, good: np.ndarray) -> None:
        self.pixels, self.points = self.pixels[good], self.points[good]
        self.views = self.views[:, good]

    def add(self, corners: np.ndarray, seen: np.ndarray) -> None:
        self.pixels = np.vstack([self.pixels, corners])
        self.points = np.vstack([self.points, np.full((len(corners), 3), np.nan)])
        views = np.full((len(self.views), len(corners), 2), np.nan)
        views[-1] = seen  # by the newest keyframe alone
        self.views = np.concatenate([self.views, views], axis=1)


def detect(image: np.ndarray, occupied: np.ndarray) -> np.ndarray:
    """Find corners where nothing is followed yet: a second track on a corner adds nothing."""
    mask = np.full(image.shape, 255, np.uint8)
    for x, y in occupied:
        cv2.circle(mask, (round(float(x)), round(float(y))), SPACING, 0, -1)
    wanted = CORNERS - len(occupied)
    if wanted <= 0:
        return np.empty((0, 2))
    found = cv2.goodFeaturesToTrack(image, wanted, 0.005, SPACING, mask=mask)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


def follow(old: np.ndarray, new: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow pixels to the next image and back again; only who comes home is believed."""
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    options = {"winSize": (17, 17), "maxLevel": 4}
    there, found, _ = cv2.calcOpticalFlowPyrLK(old, new, start, None, **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(new, old, there, None, **options)
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    there = there.reshape(-1, 2).astype(np.float64)
    height, width = old.shape
    inside = np.all((there > 8) & (there < (width - 9, height - 9)), axis=1)
    return there, inside & (off < 0.5) & (found.ravel() == 1) & (found_back.ravel() == 1)


class MonocularVo:
    """The estimator. World: the first camera; unit: the way to the second view."""

    def __init__(self, camera: odomap.Camera) -> None:
        self.camera = camera
        self.image: np.ndarray | None = None
        self.tracks = Tracks(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 0, 2)))
        self.keyframes: list[SE3] = []  # T_world_camera of each row of tracks.views
        self.T_world_camera: SE3 | None = None
        self.is_started = False

    def track(self, image: np.ndarray) -> SE3 | None:
        """Return T_world_camera of the next image, None while there is none."""
        if self.image is not None:
            self.tracks.pixels, good = follow(self.image, image, self.tracks.pixels)
            self.tracks.keep(good)
        if self.is_started:
            self.locate(image)
        elif len(self.tracks.pixels) < START_TRACKS:
            self.take_first(image)  # the first image, or one that has left the old first view
        else:
            self.start(image)
        self.image = image
        return self.T_world_camera

    def take_first(self, image: np.ndarray) -> None:
        """Make this the first of the two views to start from."""
        corners = detect(image, np.empty((0, 2)))
        views = self.camera.undistort(corners)[None]
        self.tracks = Tracks(corners, np.full((len(corners), 3), np.nan), views)
        self.keyframes = [SE3.identity()]

    def start(self, image: np.ndarray) -> None:
        """Try to begin: two views, an essential matrix, and enough parallax between them."""
        first, second = self.tracks.views[0], self.camera.undistort(self.tracks.pixels)
        # Threshold in units of the plane z = 1, since the points are given there (K = identity).
        E, mask = cv2.findEssentialMat(
            first, second, np.eye(3), cv2.RANSAC, 0.999, 1.0 / self.camera.fx
        )
        if E is None or E.shape != (3, 3):
            return
        # The mask goes in: outliers of E must not vote. It comes out smaller: cheirality.
        _, R, t, mask = cv2.recoverPose(E, first, second, np.eye(3), mask=mask)
        T_second_first = SE3.from_parts(R, t.ravel())  # OpenCV: x_second = R x_first + t
        T_world_camera = T_second_first.inverse()  # the world is the first camera
        Ts = np.stack([np.eye(4), T_world_camera.matrix])
        found = triangulate(Ts, np.stack([first, second]))
        good = (mask.ravel() > 0) & found.ahead & (found.errors * self.camera.fx < ERROR_PX)
        if (
            good.sum() < START_TRACKS
            or np.degrees(np.median(found.parallax[good])) < START_PARALLAX
        ):
            return  # turned on the spot, or hardly moved: wait, the first view stays
        self.tracks.keep(good)
        self.T_world_camera, self.is_started = T_world_camera, True
        self.add_keyframe(image)

    def locate(self, image: np.ndarray) -> None:
        """Place the camera by the landmarks it sees, in the unit they were made in."""
        known = np.isfinite(self.tracks.points[:, 0])
        points, pixels = self.tracks.points, self.tracks.pixels
        found = solve_pnp(points, pixels, self.camera, threshold_px=ERROR_PX)
        if not found.converged:  # lost; a start from nothing would have another unit
            self.T_world_camera = None
            return
        self.T_world_camera = found.T_world_camera
        way = self.camera.undistort(pixels) - self.tracks.views[-1]  # since the last keyframe
        flow_px = self.camera.fx * np.linalg.norm(way, axis=1)
        self.tracks.keep(~known | found.inliers)
        if found.num_inliers < 150 or np.nanmedian(flow_px) > 20:
            self.add_keyframe(image)

    def add_keyframe(self, image: np.ndarray) -> None:
        """Remember this view, make landmarks of what has moved enough, look for new corners."""
        assert self.T_world_camera is not None
        seen = self.camera.undistort(self.tracks.pixels)[None]
        self.tracks.views = np.concatenate([self.tracks.views, seen])[-VIEWS:]
        self.keyframes = [*self.keyframes, self.T_world_camera][-VIEWS:]
        self.triangulate()
        corners = detect(image, self.tracks.pixels)
        self.tracks.add(corners, self.camera.undistort(corners))

    def triangulate(self) -> None:
        """Put every track that has parallax where all its views say it is."""
        Ts = np.stack([T.matrix for T in self.keyframes])
        found = triangulate(Ts, self.tracks.views)
        wide = np.degrees(found.parallax) > POINT_PARALLAX
        right = found.ahead & (found.errors * self.camera.fx < ERROR_PX)
        self.tracks.points[wide & right] = found.points_world[wide & right]
        self.tracks.points[wide & ~right] = np.nan


def run(data: str = DATA) -> tuple[odomap.Trajectory, odomap.Trajectory]:
    """Return the estimated path of the first camera and the true one."""
    source = odomap.open(data)
    mount = source.rig.cameras[0]
    vo = MonocularVo(mount.camera)
    stamps, poses = [], []
    for frame in source:
        T_world_camera = vo.track(frame.images[0])
        if T_world_camera is not None:
            stamps.append(frame.stamp_ns)
            poses.append(T_world_camera)
    Ts_world_camera = source.truth.Ts_world_body @ mount.T_body_camera.matrix
    truth = odomap.Trajectory(source.truth.stamps_ns, Ts_world_camera)
    return odomap.Trajectory.of_poses(stamps, poses), truth


def main(data: str = DATA, picture: str = "exercise_1.png") -> float:
    estimate, truth = run(data)
    error = odomap.ate(estimate, truth, align="sim3")
    print(f"{len(estimate)} of {len(truth)} frames placed, {truth.path_length:.1f} m of path")
    print(f"ATE {100 * error.rmse:.1f} cm = {error.percent:.2f} % of it; scale {error.scale:.3f}")
    from odomap.views.plots import path_figure

    path_figure(estimate.transformed(error.T_reference_estimate), truth).savefig(picture, dpi=110)
    return error.percent


if __name__ == "__main__":
    main(*sys.argv[1:])
