"""The picture of a calibration: how well it fits, and what it stands on.

Four panels per camera. The scatter of residuals should be a round cloud about zero; a cloud that is
long or off centre is a board that moved or bent. The bars are the pictures: one far above the
others was blurred, or shows a board that moved. Where corners were, the lens is measured; where the
map is empty, it is extrapolated. The arrows are mean residuals, enlarged: noise points anywhere, a
wrong lens model makes rings and streams.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from odomap.backend.calibration import Calibration
from odomap.views.style import ERROR_COLOURS, PALETTE, dress, legend, new_figure, plain

__all__ = ["calibration_figure"]

Array = NDArray[np.float64]
CELLS = (16, 12)
MOST_BARS = 40
"""Beyond so many pictures, bars are not named."""


def calibration_figure(calibration: Calibration, names: tuple[tuple[str, ...], ...] = ()) -> Figure:
    """Draw residuals, pictures, coverage and systematic errors of each camera.

    Args:
        calibration: of one camera or two.
        names: of the pictures of each view, per camera.
    """
    count = len(calibration.cameras)
    figure = new_figure(12.0, 7.4 * count)
    figure.subplots_adjust(left=0.075, bottom=0.07 / count + 0.01, top=1 - 0.045 / count)
    grid = figure.subplots(2 * count, 2, gridspec_kw={"wspace": 0.15, "hspace": 0.3})
    roles = ("left camera: ", "right camera: ") if count > 1 else ("",)
    for c, role in enumerate(roles):
        _scatter(grid[2 * c, 0], calibration, c, role)
        _bars(grid[2 * c, 1], calibration, c, names[c] if names else ())
        _coverage(grid[2 * c + 1, 0], calibration, c)
        _arrows(grid[2 * c + 1, 1], calibration, c)
    return figure


def _scatter(ax: Axes, calibration: Calibration, c: int, role: str) -> None:
    """Every residual, coloured by its distance from the centre of the image."""
    used = calibration.used[c]
    r = calibration.residuals[c, used].reshape(-1, 2)
    camera = calibration.cameras[c]
    away = np.linalg.norm(
        calibration.pixels[c, used].reshape(-1, 2) - camera.intrinsics[2:], axis=1
    )
    rms = float(calibration.rms_px[c])
    title = f"{role}{camera.model}, reprojection error {rms:.3f} px RMS"
    dress(ax, title, "x [px]", "y [px]")
    order = np.argsort(away, kind="stable")
    x, y = r[order].T
    ax.scatter(x, y, s=7, c=away[order], cmap=ERROR_COLOURS, alpha=0.6, lw=0, label="corner")
    limit = max(float(np.percentile(np.abs(r), 99.5)) * 1.25, 3.2 * calibration.sigma_px)
    for k, style in ((1, "-"), (3, "--")):
        radius, label = k * calibration.sigma_px, f"{k}σ = {k * calibration.sigma_px:.3g} px"
        circle = Circle(
            (0, 0), radius, fill=False, ec=PALETTE["ink"], lw=1.0, ls=style, label=label
        )
        ax.add_patch(circle)
    ax.set_aspect("equal", adjustable="box", anchor="W")
    ax.set_xlim(-limit, limit)
    ax.set_ylim(limit, -limit)
    ax.locator_params(nbins=5)
    outside = int(np.count_nonzero(np.abs(r).max(axis=1) > limit))
    text = "blue: near the centre,\nred: far from it"
    text += f"\n{outside} beyond the axes" if outside else ""
    ax.text(
        *(1.03, 0.0, text), transform=ax.transAxes, va="bottom", fontsize=8, color=PALETTE["muted"]
    )
    legend(ax, loc="upper left", bbox_to_anchor=(1.0, 1.0), ncols=1)


def _bars(ax: Axes, calibration: Calibration, c: int, names: tuple[str, ...]) -> None:
    """RMS of each picture; those left out in another colour and hatched."""
    rms = calibration.view_rms[c]
    views = np.flatnonzero(np.isfinite(calibration.pixels[c, :, 0, 0]))
    used = calibration.used[c, views]
    values = np.nan_to_num(rms[views], nan=0.0, posinf=0.0)
    ceiling = 1.35 * float(values[used].max())
    colours = [PALETTE["estimate"] if u else PALETTE["lost"] for u in used]
    left_out = int(np.count_nonzero(~used))
    title = f"{int(used.sum())} pictures used" + (f", {left_out} left out" if left_out else "")
    dress(ax, title, "", "RMS [px]")
    bars = ax.bar(np.arange(len(views)), np.minimum(values, ceiling), color=colours, width=0.75)
    for bar, is_used, value in zip(bars, used, values):
        if not is_used:
            bar.set_hatch("///")
            x = bar.get_x() + bar.get_width() / 2
            ax.text(x, ceiling, f"{value:.1f}", ha="center", va="bottom", fontsize=7)
    mean = float(calibration.rms_px[c])
    ax.axhline(mean, color=PALETTE["ink"], lw=1.0, ls="--")
    ax.set_xlim(-0.8, len(views) - 0.2)
    ax.set_ylim(0, 1.08 * ceiling)
    ax.grid(False, axis="x")
    if names and len(views) <= MOST_BARS:
        labels = [_short(names[v]) for v in views]
        ax.set_xticks(np.arange(len(views)), labels, rotation=90, fontsize=6.5)
    else:
        ax.set_xlabel("picture")


def _short(name: str) -> str:
    stem = name.rpartition(".")[0] or name
    return plain(stem if len(stem) <= 12 else "…" + stem[-11:])


def _coverage(ax: Axes, calibration: Calibration, c: int) -> None:
    """Where corners were, over a map of how many."""
    camera = calibration.cameras[c]
    uv = calibration.pixels[c, calibration.used[c]].reshape(-1, 2)
    width, height = camera.resolution
    box = ((-0.5, width - 0.5), (-0.5, height - 0.5))
    counts = np.histogram2d(uv[:, 0], uv[:, 1], CELLS, box)[0].T
    empty = 100.0 * float(np.mean(counts == 0))
    dress(ax, f"Coverage: {empty:.0f} % of the picture without a corner", "x [px]", "y [px]")
    ax.imshow(
        np.ma.masked_equal(counts, 0),
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
        cmap="Blues",
        vmin=0,
        vmax=max(1.0, float(counts.max())) * 1.4,
        interpolation="nearest",
    )
    ax.set_aspect("equal", anchor="W")
    ax.plot(uv[:, 0], uv[:, 1], ".", ms=1.6, color=PALETTE["ink"], alpha=0.6)
    ax.plot(camera.cx, camera.cy, "+", ms=11, mew=1.6, color=PALETTE["lost"], label="centre")
    _frame(ax, width, height)
    legend(ax, loc="upper left", bbox_to_anchor=(1.0, 1.0), ncols=1)


def _arrows(ax: Axes, calibration: Calibration, c: int) -> None:
    """Mean residual per cell, enlarged."""
    camera = calibration.cameras[c]
    used = calibration.used[c]
    uv = calibration.pixels[c, used].reshape(-1, 2)
    r = calibration.residuals[c, used].reshape(-1, 2)
    width, height = camera.resolution
    cell = np.clip(((uv + 0.5) / (width, height) * CELLS).astype(int), 0, np.array(CELLS) - 1)
    index = cell[:, 1] * CELLS[0] + cell[:, 0]
    size = CELLS[0] * CELLS[1]
    counts = np.bincount(index, minlength=size)
    enough = counts >= 3
    share = 1.0 / counts[enough]
    mean, place = (
        np.stack([np.bincount(index, a[:, k], size)[enough] * share for k in (0, 1)], axis=1)
        for a in (r, uv)
    )
    longest = float(np.percentile(np.linalg.norm(mean, axis=1), 95)) if len(mean) else 1.0
    factor = _round_number(0.9 * width / CELLS[0] / max(longest, 1e-9))
    dress(ax, f"Mean residual by place, {factor:g} times enlarged", "x [px]", "y [px]")
    ax.quiver(
        *place.T, *mean.T, angles="xy", scale_units="xy", scale=1.0 / factor, width=0.003,
        color=PALETTE["estimate"],
    )  # fmt: skip
    ax.set_aspect("equal", anchor="W")
    _frame(ax, width, height)


def _frame(ax: Axes, width: int, height: int) -> None:
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    for spine in ax.spines.values():
        spine.set_visible(True)
        spine.set_color(PALETTE["muted"])


def _round_number(value: float) -> float:
    """Return the nearest of 1, 2, 5 times a power of ten below a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-9)))
