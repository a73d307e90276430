"""The part that local mapping works on: what holds it where a camera comes back by itself."""

import numpy as np
import pytest

from odomap.maps.edges import LOOP
from odomap.system.localmap import LocalMapConfig
from odomap.system.localpart import MappingConfig, choose_part
from system.circuits import CAMERA, Circuit, Walls, around

LOCAL, CONFIG = LocalMapConfig(), MappingConfig()


def returned(shared=60, keyframes=80):
    """Return a circuit whose last keyframe observes so many of the first ones' landmarks, too."""
    circuit = Circuit(around(keyframes), Walls.make(), seed=1)
    for _ in range(keyframes):
        circuit.add()
    m, last = circuit.map, keyframes - 1
    seen, _ = m.observations_of(last)
    shown = {circuit.points_of[k]: k for k in seen.tolist()}
    old = [k for k in m.landmarks_of(range(12)).tolist() if circuit.points_of[k] in shown]
    old = np.array(old[:shared])
    assert len(old) == shared
    m.fuse_landmarks(old, [shown[circuit.points_of[k]] for k in old.tolist()])
    return circuit, last


def part_of(circuit, last):
    part = choose_part(circuit.map, last, CAMERA, CONFIG, LOCAL)
    ids, is_fixed = part.snapshot.keyframe_ids, part.snapshot.is_fixed
    return part, set(ids[~is_fixed].tolist()), set(ids[is_fixed].tolist())


def test_the_old_part_holds_where_the_camera_comes_back():
    circuit, last = returned()
    part, free, held = part_of(circuit, last)
    assert last in free
    assert min(free) > 60
    assert held & set(range(13))
    # How sure the new keyframe is is still what the way round says.
    assert part.anchor_id > 50


def test_once_a_loop_is_measured_both_parts_are_adjusted():
    circuit, last = returned(shared=250)
    old = [k for k in circuit.map.covisible(last)[0].tolist() if k < 13]
    assert not part_of(circuit, last)[1] & set(range(13))
    circuit.map.add_edge(old[0], last, np.eye(4), np.eye(6), LOOP)
    assert part_of(circuit, last)[1] & set(range(13))


@pytest.mark.parametrize("last", [1, 5, 40])
def test_on_new_ground_nothing_changes(last):
    circuit = Circuit(around(80), Walls.make(), seed=1)
    for _ in range(last + 1):
        circuit.add()
    shared, counts = circuit.map.covisible(last)
    chosen = shared[counts >= CONFIG.min_shared][: CONFIG.size - 1].tolist()
    _, free, held = part_of(circuit, last)
    assert free | ({0} & held) == {last, *chosen} or free == {last, *chosen}
    assert held
