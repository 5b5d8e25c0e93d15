"""Input that moves the camera."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from pansplat_viewer.core.state import ViewerState, enter_scene
from pansplat_viewer.window.input import Input, apply_input


def test_a_camera_that_flies_by_hand_stops_along_a_poor_edge(small_scene, house):
    """The state has the graph with the poor edges that were found."""
    state = ViewerState()
    enter_scene(state, small_scene)
    (a, b), *_ = house.overlaps
    state.graph, state.is_tour = replace(house, poor=((a, b),)), True
    way = house.positions[b] - house.positions[a]
    ahead = np.linalg.inv(np.asarray(state.camera.level)) @ way
    state.camera = replace(
        state.camera, position=tuple(house.positions[a]), yaw_radians=float(np.arctan2(ahead[0], ahead[2]))
    )
    for _ in range(200):
        apply_input(Mock(state=state), Input(held=frozenset("w"), seconds=0.05 * float(np.linalg.norm(way))))
    away = np.linalg.norm(np.array(state.camera.position) - house.positions[a])
    assert away == pytest.approx(min(0.5, np.linalg.norm(way) / 4), abs=1e-6)
