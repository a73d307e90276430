"""Halves of real recordings, mapped apart and merged: as good as the undivided run."""

import numpy as np
import pytest

from odomap.evaluation.metrics import ate
from odomap.files.mapexport import keyframe_trajectory
from odomap.maps.atlas import Atlas
from odomap.merge import merge_maps
from odomap.savedmap import SavedMap
from odomap.sources.open import open as open_source
from odomap.system.config import preset
from odomap.system.slam import Slam

SHARED = 0.1
"""Part of the recording that both halves see."""


def mapped(source, frames, sensors):
    """Return the map of some frames, and their keyframes."""
    slam = Slam(source.rig, preset(sensors))
    for frame in frames:
        slam.track(frame)
    return slam.finish().map


@pytest.mark.parametrize(("name", "sensors"), [("rgbd_desk", "rgbd"), ("euroc_mh01", "stereo")])
def test_two_halves_merged_are_as_good_as_the_whole(data_folder, name, sensors):
    source = open_source(data_folder / name)
    frames = list(source)
    first = frames[: round((0.5 + SHARED / 2) * len(frames))]
    second = frames[round((0.5 - SHARED / 2) * len(frames)) :]
    whole, *halves = (mapped(source, part, sensors) for part in (frames, first, second))
    merged = merge_maps(*(SavedMap(name, half, source.rig, sensors) for half in halves))
    off = [ate(keyframe_trajectory(m), source.truth).rmse for m in (whole, *halves, merged.map)]
    print(f"{name}: {merged.summary}; whole, halves, merged: {np.round(off, 4)} m")
    assert merged.num_places >= 3
    assert merged.landmarks_fused > 100
    assert len(Atlas(merged.map).pieces) == 1
    # Both halves are as sure of themselves as the whole is; little is lost in between.
    assert off[3] < 1.5 * off[0] + 0.005
