"""Draw docs/images/demo.png: a frame with its tracks, and the path against the truth.

Run it with `python docs/images/make_demo.py`; the world is simulated, so that anyone gets the same.
"""

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import odomap
from odomap.views.frames import frame_figure
from odomap.views.plots import path_figure

WORLD, SHOWN, HEIGHT = "sim:room?seed=3&frames=150", 66, 360


def pixels(figure: Figure, **options: object) -> Image.Image:
    """Render a figure, scaled to the common height."""
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=150, **options)
    image = Image.open(out).convert("RGB")
    width = round(image.width * HEIGHT / image.height)
    return image.resize((width, HEIGHT), Image.Resampling.LANCZOS)


def main() -> None:
    """Track, draw, put side by side."""
    source = odomap.open(WORLD)
    system = odomap.StereoVO(source.rig)
    for frame in source:
        estimate = system.track(frame)
        if frame.id == SHOWN:
            shown = frame_figure(frame.images[0], estimate.tracks)
    path = path_figure(system.finish().trajectory, source.truth)
    halves = [np.asarray(pixels(figure)) for figure in (shown, path)]
    Image.fromarray(np.hstack(halves)).save(Path(__file__).with_name("demo.png"), optimize=True)


if __name__ == "__main__":
    main()
