"""Rooms exchange light through doors, and share it through wide openings."""

import numpy as np

from pansplat_homes.lighting import add_lights, light_groups, sample_mood
from pansplat_homes.plans import Hole, HoleKind, Plan, Room, RoomKind, Wall
from pansplat_homes.raytracer import AMBIENT, LIGHT_GROUP
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern

DOOR = Hole(1.0, 1.9, 0.0, 2.0, HoleKind.DOOR)


def _plan(hole: Hole) -> Plan:
    """Two rooms of 4 x 4 metres, of which the first has a window, with a hole between them."""
    rooms = (Room((0, 0, 4, 4), RoomKind.LIVING), Room((4, 0, 8, 4), RoomKind.LIVING))
    outer = Wall(0, 0.0, 0.0, 4.0, (-1, 0), [Hole(1.0, 3.0, 0.8, 2.1, HoleKind.WINDOW)])
    return Plan(rooms, (outer, Wall(0, 4.0, 0.0, 4.0, (0, 1), [hole])))


def _ambient(openness: float) -> np.ndarray:
    builder, plan = SceneBuilder(np.random.default_rng(0)), _plan(DOOR)
    material = builder.add_material(Pattern.PLAIN, (0.6, 0.6, 0.6))
    mood = sample_mood(np.random.default_rng(3), plan)
    rows = [([material] * 5, 0.0, 0.1)] * 2
    add_lights(builder, plan, rows, np.array((2.5, 2.5)), [], {DOOR: openness}, mood, True)
    return np.array([row[AMBIENT:LIGHT_GROUP].mean() for row in builder.rooms])


def test_an_open_door_lights_the_room_without_windows() -> None:
    closed, ajar, wide = _ambient(0.0), _ambient(0.4), _ambient(1.0)
    assert closed[0] > ajar[0] and closed[1] < ajar[1] < ajar[0]
    assert ajar[1] / ajar[0] < wide[1] / wide[0] < 1


def test_wide_openings_join_light_groups_and_doors_do_not() -> None:
    assert light_groups(_plan(Hole(0.5, 3.5, 0.0, 2.2, HoleKind.OPENING))) == [0, 0]
    assert light_groups(_plan(Hole(1.0, 1.9, 0.0, 2.2, HoleKind.OPENING))) == [0, 1]
    assert light_groups(_plan(DOOR)) == [0, 1]
