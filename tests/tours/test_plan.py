"""The doors of a floor plan, and how sure its lengths are."""

import math

import numpy as np
import pytest
from synthetic_houses import CAMERAS, HALL, L_ROOM, WALLS, make_plan, make_rooms, make_walls_scene, walls_around


def test_the_uncertainty_of_walls_is_the_disagreement_of_the_panoramas_that_show_them() -> None:
    exact = make_plan(make_rooms())
    assert exact.wall_error == pytest.approx(0, abs=0.005) and exact.num_walls >= 6
    shifted = make_plan(make_walls_scene(WALLS, CAMERAS, shifts=((0.03, 0.03), (-0.03, -0.03), (0, 0))))
    assert shifted.wall_error == pytest.approx(0.06 / math.sqrt(2), rel=0.25)
    room = shifted.rooms[0]
    walls = math.sqrt(sum(side**2 for side in (5, 3, 2, 3, 3, 6)))
    expected = math.hypot(shifted.wall_error * walls, 0.2 * room.shape.area)
    assert shifted.area_error(room) == pytest.approx(expected, rel=0.05)
    alone = make_plan(make_walls_scene(walls_around(HALL), CAMERAS[2:]))
    assert alone.wall_error is None and alone.scale_error is None
    assert alone.area_error(alone.rooms[0]) == pytest.approx(0.2 * 15.6, rel=0.05), "of its shape"


def test_a_door_is_where_the_floor_beyond_is_seen_and_joins_both_rooms() -> None:
    plan = make_plan(make_rooms())
    (door,) = plan.doors
    assert sorted(door.rooms) == [0, 1]
    assert door.ends.mean(axis=0) == pytest.approx((5.05, 1.45), abs=0.1)
    assert np.linalg.norm(door.ends[1] - door.ends[0]) == pytest.approx(0.9, abs=0.2)
    closed = make_walls_scene([*walls_around(L_ROOM), *walls_around(HALL)], CAMERAS)
    assert make_plan(closed).doors == ()


def test_a_window_above_a_sill_is_no_door() -> None:
    """The opening starts 0.9 m over the floor."""
    sills = [(start, end, -0.9) for start, end, lower in WALLS if lower]
    assert len(sills) == 2 and make_plan(make_walls_scene([*WALLS, *sills], CAMERAS)).doors == ()
