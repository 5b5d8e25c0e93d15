"""Straight walls from the floor's ends."""

import dataclasses
import math

import numpy as np
import pytest

from pansplat.sweep.cost import Family
from pansplat.sweep.floor import FloorClues
from pansplat.sweep.frame import main_directions
from pansplat.sweep.walls import Walls, add_walls, believe, find_walls

_HEIGHT = 128
_AZIMUTH = ((np.arange(2 * _HEIGHT) + 0.5) / (2 * _HEIGHT) * 2 - 1) * math.pi
_BELOW, _FAR = 1.4, 8.0  # of the floor under the camera, and to the farthest plane, metres


def _clues(ends: np.ndarray) -> FloorClues:
    nothing = np.zeros(ends.shape[1])
    return FloorClues(np.zeros(ends.shape), nothing, nothing, nothing, ends, np.zeros(ends.shape))


def _ends_of(distance: np.ndarray) -> np.ndarray:
    """The ends (rows, azimuths) of a floor that reaches so far (azimuths), each a pixel high."""
    ends = np.zeros((_HEIGHT, 2 * _HEIGHT))
    row = np.rint((np.arctan(_BELOW / distance) / math.pi + 0.5) * _HEIGHT - 1).astype(np.int64)
    ends[row, np.arange(2 * _HEIGHT)] = 1
    return ends


def _square(half: float) -> np.ndarray:
    """How far away (azimuths) the walls of a square room are whose middle the camera stands in."""
    return half / np.maximum(np.abs(np.cos(_AZIMUTH)), np.abs(np.sin(_AZIMUTH)))


@pytest.fixture
def square_walls() -> Walls:
    return find_walls(_clues(_ends_of(_square(1.5))), _BELOW, _FAR)


def _true_axis() -> np.ndarray:
    return np.where(np.abs(np.cos(_AZIMUTH)) > np.abs(np.sin(_AZIMUTH)), 1, 2)


@pytest.mark.parametrize("view", (0, 1))
def test_a_rooms_four_walls_are_found(two_coloured, empty_room, room_axes, view):
    clue, room = two_coloured[0][view], empty_room.room
    centre = empty_room.posed.cam2world[view][:3, 3] @ room_axes.T
    low, high = (np.array(corner) @ room_axes.T - centre for corner in (room.low, room.high))
    walls = find_walls(clue, float(high[0]), empty_room.posed.far)
    azimuth = ((np.arange(len(walls.axis)) + 0.5) / len(walls.axis) * 2 - 1) * math.pi
    along = np.stack((np.cos(azimuth), np.sin(azimuth)))
    reach = np.where(along > 0, high[1:, None], low[1:, None]) / along
    axis = reach.argmin(axis=0)
    offset = np.where(along > 0, high[1:, None], low[1:, None])[axis, np.arange(len(axis))]
    right = (walls.axis == axis + 1) & (walls.strength > 0.9)
    assert right.mean() > 0.9
    # A pixel is 1.9 degrees here, a tenth of what is 2.8 m away.
    assert np.abs(walls.offset[right] / offset[right] - 1).max() < 0.12


def test_a_wall_bridges_what_no_end_shows(square_walls):
    ends = _ends_of(_square(1.5))
    ends[:, 120:124] = 0  # in the middle of a wall
    bridged = find_walls(_clues(ends), _BELOW, _FAR)
    assert len(np.unique(bridged.number[112:140])) == 1
    assert np.abs(bridged.offset[120:124] / 1.5 - 1).max() < 0.05
    assert (square_walls.axis == _true_axis()).mean() > 0.95
    assert (np.abs(np.abs(square_walls.offset) / 1.5 - 1) < 0.05).mean() > 0.95


def test_walls_do_not_end_where_the_panorama_does(square_walls):
    """The wall behind the camera begins at the last columns and goes on at the first."""
    assert square_walls.number[0] == square_walls.number[-1]
    assert square_walls.strength[0] == square_walls.strength[-1] > 0.9
    turned = find_walls(_clues(np.roll(_ends_of(_square(1.5)), _HEIGHT, axis=1)), _BELOW, _FAR)
    assert np.allclose(turned.offset, -np.roll(square_walls.offset, _HEIGHT))


@pytest.mark.parametrize("scale", (0.1, 10.0))
def test_a_larger_world_has_larger_walls(square_walls, scale):
    walls = find_walls(_clues(_ends_of(_square(1.5))), scale * _BELOW, scale * _FAR)
    assert (walls.axis == square_walls.axis).all()
    assert np.allclose(walls.offset[walls.axis > 0], scale * square_walls.offset[walls.axis > 0])


def test_without_ends_there_are_no_walls():
    walls = find_walls(_clues(np.zeros((_HEIGHT, 2 * _HEIGHT))), _BELOW, _FAR)
    assert (walls.axis == 0).all() and (walls.number == -1).all() and (walls.strength == 0).all()


def test_narrow_walls_are_hardly_believed(square_walls):
    """A post 6 degrees wide in front of a wall."""
    distance = _square(1.5)
    distance[126:130] = 0.7
    posted = find_walls(_clues(_ends_of(distance)), _BELOW, _FAR)
    assert np.abs(posted.offset[128] / 0.7 - 1) < 0.1
    assert 0.3 < posted.strength[128] < 0.8 < square_walls.strength[128]


@pytest.mark.parametrize(
    ("distance", "agreed", "left"),
    ((1.0, True, 1.0), (0.6, True, 0.0), (0.6, False, 1.0)),
    ids=("agreed to be there", "agreed to be elsewhere", "nothing agreed"),
)
def test_a_wall_is_believed_unless_views_agree_on_another_surface(square_walls, room_axes, distance, agreed, left):
    rays = main_directions(room_axes, np.eye(3), _HEIGHT)
    walls = 1.5 / np.maximum(np.abs(rays[1]), np.abs(rays[2]))
    known = np.full(rays[0].shape, agreed)
    clues = _clues(np.zeros((_HEIGHT, 2 * _HEIGHT)))
    believed = believe(square_walls, clues, rays, 1 / (distance * walls), known)
    assert np.allclose(believed.strength, left * square_walls.strength, atol=1e-6)


def test_without_walls_nothing_is_believed_or_added(room_axes):
    clues = _clues(np.zeros((_HEIGHT, 2 * _HEIGHT)))
    none = find_walls(clues, _BELOW, _FAR)
    rays = main_directions(room_axes, np.eye(3), _HEIGHT)
    shape = rays[0].shape
    assert (believe(none, clues, rays, np.ones(shape), np.ones(shape, bool)).strength == 0).all()
    slopes, nothing = np.abs(rays).astype(np.float32), np.zeros((2, 1), np.float32)
    families = [Family(slope, slope, nothing, np.zeros(shape, np.uint8)) for slope in (slopes[0], *slopes)]
    cost = np.zeros((*shape, 4), np.float32)
    add_walls(cost, none, clues, families, rays, -1.0, 2.0)
    assert (cost == 0).all()


def test_the_wall_is_cheapest_between_the_floor_and_the_ceiling(square_walls, room_axes):
    rays = main_directions(room_axes, np.eye(3), _HEIGHT)
    shape, count, ceiling = rays[0].shape, 50, -1.0
    inverse = np.linspace(0.1, 2.0, count)
    families = [
        Family(
            (inverse[0] * s).astype(np.float32), ((inverse[1] - inverse[0]) * s).astype(np.float32),
            np.zeros((2, count), np.float32), np.zeros(shape, np.uint8),
        )
        for s in (np.ones(shape), *np.abs(rays))
    ]  # fmt: skip
    cost = np.zeros((*shape, 4 * count), np.float32)
    clues = _clues(np.zeros(shape))
    walls = dataclasses.replace(square_walls, strength=np.ones(2 * _HEIGHT))
    add_walls(cost, walls, clues, families, rays, ceiling, 2.0)
    axis = np.where(np.abs(rays[1]) > np.abs(rays[2]), 1, 2)
    depth = 1.5 / np.maximum(np.abs(rays[1]), np.abs(rays[2]))
    height = rays[0] * depth  # downwards
    between = (height < _BELOW - 0.15) & (height > ceiling + 0.15)
    corner = np.abs(np.abs(rays[1]) - np.abs(rays[2])) < 0.1 * np.hypot(rays[1], rays[2])
    best = cost.argmin(axis=-1)[between & ~corner]
    assert (best // count == 1 + axis[between & ~corner]).all()
    assert np.abs(inverse[best % count] * 1.5 - 1).max() < 0.1
    assert cost.min(axis=-1)[between & ~corner].max() < -1
    assert (cost[(height > _BELOW + 0.25) | (height < ceiling - 0.15)] == 0).all()
    assert (cost[..., : 2 * count] == 0).all()  # spheres and what is level are no walls
