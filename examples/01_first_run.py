"""Track a stereo camera through a simulated room, score the path, and draw it.

Run it with `python examples/01_first_run.py [OUT.png]`. The picture in the README comes from here.
"""

import sys

import odomap


def main(picture: str, data: str = "sim:room?seed=3&frames=120") -> float:
    # A source yields frames, says what is mounted where, and knows the truth if there is one.
    source = odomap.open(data)

    # A system turns frames into estimates, one by one, as a robot would see them.
    system = odomap.StereoVO(source.rig)
    for frame in source:
        estimate = system.track(frame)
        if estimate.status is odomap.Status.LOST:
            print(f"frame {frame.id}: {estimate.reason}")

    # At the end the path is known best: later frames have corrected earlier ones.
    trajectory = system.finish().trajectory
    error = odomap.ate(trajectory, source.truth)
    print(f"{len(trajectory)} poses, {error.path_m:.1f} m, ATE {1000 * error.rmse:.1f} mm")

    # Pictures are plain matplotlib figures.
    from odomap.views.plots import path_figure

    path_figure(trajectory, source.truth).savefig(picture, dpi=110)
    return error.rmse


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "first_run.png")
