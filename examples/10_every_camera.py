"""One camera, a camera with depth, two cameras: the same room, three odometries.

Run it with `python examples/10_every_camera.py`; docs/lesson/02_visual_odometry.md explains it.
"""

import odomap

DATA = "sim:room?seed=4&frames=20&sensors="


def follow(
    system: odomap.MonocularVO | odomap.RgbdVO | odomap.StereoVO, source: odomap.Source
) -> odomap.Result:
    """Track a whole recording, as a robot would: frame by frame."""
    for frame in source:
        estimate = system.track(frame)
        if estimate.status is odomap.Status.LOST:
            print(f"frame {frame.id}: {estimate.reason}")
    return system.finish()


def main() -> dict[str, float]:
    results = {}
    for name, sensors in (("mono", "mono"), ("rgbd", "mono,depth"), ("stereo", "stereo")):
        source = odomap.open(DATA + sensors)
        if name == "mono":
            system = odomap.MonocularVO(source.rig.cameras[0].camera)
        else:
            system = odomap.RgbdVO(source.rig) if name == "rgbd" else odomap.StereoVO(source.rig)
        result = follow(system, source)
        # One camera cannot know its unit of length: its path may be scaled, others must not be.
        error = odomap.ate(result.trajectory, source.truth, "se3" if result.is_metric else "sim3")
        unit = "metres" if result.is_metric else "a unit of its own"
        print(f"{name:6}: {error.matched} poses in {unit}, ATE {error.percent:.1f} % of the path")
        results[name] = error.percent
    # `odomap.run` chooses by what the rig carries: depth, two cameras, or one.
    return results


if __name__ == "__main__":
    main()
