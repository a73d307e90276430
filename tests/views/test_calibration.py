"""The picture of a calibration shows what is in it."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from odomap.backend.calibration import Calibration
from odomap.geometry.camera import Camera
from odomap.geometry.pose import SE3
from odomap.views.calibration import calibration_figure
from odomap.views.style import PALETTE, figure_png

CAMERA = Camera(intrinsics=(300.0, 300.0, 160.0, 120.0), resolution=(320, 240))


def made(cameras: int = 1, views: int = 6) -> Calibration:
    """A calibration whose second view is left out and whose last is not seen."""
    rng = np.random.default_rng(4)
    pixels = rng.uniform(20, 220, (cameras, views, 30, 2))
    pixels[:, -1] = np.nan
    residuals = rng.normal(0, 0.2, pixels.shape)
    residuals[:, 1] *= 40
    residuals[:, -1] = np.nan
    used = np.isfinite(pixels[:, :, 0, 0])
    used[:, 1] = False
    return Calibration(
        cameras=(CAMERA,) * cameras,
        T_left_right=SE3.exp([0.1, 0, 0, 0, 0, 0]) if cameras > 1 else None,
        covariance=np.eye(4 * cameras + 6 * (cameras - 1)) * 1e-4,
        Ts_camera_board=np.tile(np.eye(4), (views, 1, 1)),
        pixels=pixels,
        residuals=residuals,
        used=used,
        sigma_px=0.2,
        converged=True,
    )


@pytest.mark.parametrize("cameras", [1, 2])
def test_there_are_four_panels_per_camera(cameras: int) -> None:
    figure = calibration_figure(made(cameras))
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 4 * cameras
    png = figure_png(figure, dpi=50)
    assert png == figure_png(calibration_figure(made(cameras)), dpi=50)


def test_bars_are_the_pictures_and_those_left_out_are_marked() -> None:
    found = made()
    names = (tuple(f"img_{k}.png" for k in range(6)),)
    bars = calibration_figure(found, names).axes[1]
    assert [label.get_text() for label in bars.get_xticklabels()] == [f"img_{k}" for k in range(5)]
    heights = [patch.get_height() for patch in bars.patches]
    assert heights[0] == pytest.approx(found.view_rms[0, 0])
    assert [bool(patch.get_hatch()) for patch in bars.patches] == [False, True, False, False, False]
    assert heights[1] < found.view_rms[0, 1]  # cut off, its height written above it
    assert f"{found.view_rms[0, 1]:.1f}" in [text.get_text() for text in bars.texts]
    assert bars.get_title(loc="left") == "4 pictures used, 1 left out"


def test_residuals_and_corners_of_views_used_are_drawn() -> None:
    found = made()
    scatter, _, coverage, arrows = calibration_figure(found).axes
    offsets = np.asarray(scatter.collections[0].get_offsets())
    expected = found.residuals[0, found.used[0]].reshape(-1, 2)
    assert np.allclose(np.sort(offsets, axis=0), np.sort(expected, axis=0))
    dots = np.column_stack(coverage.lines[0].get_data())
    assert np.allclose(dots, found.pixels[0, found.used[0]].reshape(-1, 2))
    assert coverage.get_ylim()[0] > coverage.get_ylim()[1]  # y is down, as in the picture
    assert "without a corner" in coverage.get_title(loc="left")
    assert "times enlarged" in arrows.get_title(loc="left")
    assert arrows.collections[0].get_facecolor()[0][:3] == pytest.approx(
        tuple(int(PALETTE["estimate"][k : k + 2], 16) / 255 for k in (1, 3, 5))
    )
