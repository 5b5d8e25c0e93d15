"""Doors are openings down to the floor."""

import numpy as np
import pytest
from synthetic_houses import CAMERAS, HALL, L_ROOM, WALLS, make_plan, make_rooms, make_walls_scene, walls_around


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
