"""What one picture says of the floor.

---
Straight walls from the floor's ends."""

import dataclasses
import math

import numpy as np
import pytest

from pansplat.sweep.matching import HypothesisSet
from pansplat.sweep.planes import axis_components
from pansplat.sweep.room_layout import (
    FloorBoundary,
    RoomLayoutConfig,
    Walls,
    apply_floor_costs,
    apply_wall_bonus,
    discount_contradicted,
    fit_walls,
)


@pytest.mark.parametrize("view", (0, 1))
def test_what_is_painted_like_the_floor_looks_like_it(two_coloured, empty_room, view):
    clues, rays = two_coloured
    pose, depth = empty_room.posed.cam2world[view], empty_room.depths[view]
    height = rays[view][0] * depth + pose[1, 3]
    floor = np.abs(height - empty_room.room.high[1]) < 1e-3
    assert (clues[view].floor_score[floor] > 0.2).mean() > 0.95
    assert (clues[view].floor_score[~floor] < -0.2).mean() > 0.95


@pytest.mark.parametrize("view", (0, 1))
def test_the_floor_ends_where_the_walls_stand(two_coloured, empty_room, room_axes, view):
    clue, room = two_coloured[0][view], empty_room.room
    centre = empty_room.posed.cam2world[view][:3, 3] @ room_axes.T
    azimuths = len(clue.angle)
    azimuth = ((np.arange(azimuths) + 0.5) / azimuths * 2 - 1) * math.pi  # of a panorama's columns
    low, high = (np.array(corner) @ room_axes.T - centre for corner in (room.low, room.high))
    along = np.stack((np.cos(azimuth), np.sin(azimuth)))
    walls = np.where(along > 0, high[1:, None], low[1:, None]) / along
    true = walls.min(axis=0)
    sure = clue.confidence > 0.5
    assert sure.mean() > 0.8
    assert np.median(np.abs(clue.distance[sure] / true[sure] - 1)) < 0.05
    assert (np.abs(clue.distance[sure] / true[sure] - 1) < 0.15).mean() > 0.95
    assert np.allclose(np.tan(clue.angle) * clue.distance, room.high[1] - centre[0], atol=1e-6)


def test_a_wall_in_the_floors_colours_stands_where_its_edge_is(empty_room, find_clues, room_axes):
    """One wall is painted like the floor, a little darker."""
    posed, room, images = empty_room.posed, empty_room.room, []
    wall = np.array(room.high)[2]
    for pose, depth, image in zip(posed.cam2world, empty_room.depths, posed.images, strict=True):
        rays = axis_components(room_axes, pose[:3, :3], image.shape[0])
        height, across = rays[0] * depth + pose[1, 3], rays[2] * depth + pose[2, 3]
        on_floor, on_wall = np.abs(height - room.high[1]) < 1e-3, np.abs(across - wall) < 1e-3
        dapples = (0.8 + 0.4 * image.mean(axis=2))[..., None]
        paint = np.where(on_floor[..., None], np.array((0.45, 0.3, 0.15)) * dapples, 0.85 * dapples)
        images.append(np.where(on_wall[..., None], np.array((0.345, 0.23, 0.115)) * dapples, paint))
    clues, rays = find_clues(posed, np.stack(images).clip(0, 1).astype(np.float32), room.high[1])
    assert clues is not None
    for clue, pose in zip(clues, posed.cam2world, strict=True):
        azimuth = ((np.arange(len(clue.angle)) + 0.5) / len(clue.angle) * 2 - 1) * math.pi
        facing = np.sin(azimuth) > 0.85  # the wall is across the third axis
        true = (wall - pose[2, 3]) / np.sin(azimuth[facing])
        right = np.abs(clue.distance[facing] / true - 1) < 0.15
        sure = clue.confidence[facing] > 0.3
        assert sure.mean() > 0.3
        assert right[sure].mean() > 0.9


def test_without_a_floor_nothing_is_said(empty_room, find_clues):
    assert find_clues(empty_room.posed, empty_room.posed.images, math.inf)[0] is None


def test_one_paint_everywhere_says_nothing(empty_room, find_clues):
    clues, _ = find_clues(empty_room.posed, np.full_like(empty_room.posed.images, 0.5), empty_room.room.high[1])
    assert clues is not None
    for clue in clues:
        assert np.abs(clue.floor_score).max() < 0.1
        assert clue.confidence.max() == 0


def test_where_the_floor_matches_badly_no_foot_is_believed(two_coloured, empty_room, find_clues):
    """The pictures of the two views, exchanged: what looks like floor does not match as floor."""
    posed = empty_room.posed
    images = np.stack((posed.images[0], np.random.default_rng(1).random(posed.images[1].shape).astype(np.float32)))
    clues, _ = find_clues(posed, images, empty_room.room.high[1])
    assert clues is not None
    believed = np.mean([clue.confidence for clue in clues])
    assert believed < 0.05 < np.mean([clue.confidence for clue in two_coloured[0]])


def test_a_foot_fades_where_the_picture_changes_above_it(room_axes):
    """A foot 30 degrees below the horizon, and an edge all around 10 degrees above the horizon."""
    rays = axis_components(room_axes, np.eye(3), 64)
    angle = ((np.arange(64) + 0.5) / 64 - 0.5) * math.pi
    change = np.repeat(np.where(angle < math.radians(-10), 2.0, 0.0)[:, None], 128, axis=1)
    nothing, end = np.zeros(128), np.full(128, math.radians(30))
    fading = FloorBoundary(np.zeros((64, 128)), end, nothing, nothing, np.zeros((64, 128)), change).fading(end, rays)
    down = np.degrees(np.arcsin(rays[0]))
    assert (fading[down > 31] == 0).all()
    assert np.allclose(fading[(down < 29) & (down > -8)], 1)
    assert np.allclose(fading[down < -12], math.exp(-2))


def test_clues_favour_the_floor_below_its_end_and_what_stands_there_above(room_axes):
    """A floor 1 m below that ends 2 m away: below the end it looks like floor, above it does not."""
    shape, count = (32, 64), 40
    rays = axis_components(room_axes, np.eye(3), 32)
    end = math.atan2(1, 2)
    like = np.where(np.arcsin(rays[0]) > end, 1, -1).astype(np.float32)
    clues = FloorBoundary(like, np.full(64, end), np.full(64, 2.0), np.ones(64), np.zeros(shape), np.zeros(shape))
    inverse = np.linspace(0.1, 2.05, count)
    slopes = [np.ones(shape), *np.abs(rays)]
    families = [
        HypothesisSet(
            (inverse[0] * s).astype(np.float32), ((inverse[1] - inverse[0]) * s).astype(np.float32),
            np.zeros((2, count), np.float32), np.zeros(shape, np.uint8),
        )
        for s in slopes
    ]  # fmt: skip
    cost = np.zeros((*shape, 4 * count), np.float32)
    config = RoomLayoutConfig()
    is_floor = np.abs(1 / inverse - 1) < 0.03
    assert is_floor.sum() == 1
    apply_floor_costs(cost, clues, families, is_floor, rays, config)
    floor = count + int(is_floor.argmax())
    below, above = np.arcsin(rays[0]) > end + 0.05, (rays[0] > 0) & (np.arcsin(rays[0]) < end - 0.05)
    assert np.allclose(cost[below][:, floor], 0) and np.allclose(np.delete(cost[below], floor, axis=1), 0.3)
    assert np.allclose(cost[above][:, floor], config.not_floor_penalty)
    planes = cost[above].reshape(-1, 4, count)
    best = inverse[planes[:, 0].argmin(axis=-1)]
    wanted = np.sqrt(1 - rays[0][above] ** 2) / 2
    assert np.abs(best / wanted - 1).max() < 0.15
    assert planes[:, 0].min(axis=-1).max() < -0.5 * config.boundary_bonus * math.exp(-end / config.boundary_decay)
    assert (planes[:, 1] >= 0).all()  # what is level does not stand
    sky = rays[0] < -0.9
    assert np.abs(cost[sky]).max() < config.boundary_bonus * math.exp(-(end + 1.1) / config.boundary_decay) + 1e-6


_HEIGHT = 128
_AZIMUTH = ((np.arange(2 * _HEIGHT) + 0.5) / (2 * _HEIGHT) * 2 - 1) * math.pi
_BELOW, _FAR = 1.4, 8.0  # of the floor under the camera, and to the farthest plane, metres


def _find_boundary(ends: np.ndarray) -> FloorBoundary:
    nothing = np.zeros(ends.shape[1])
    return FloorBoundary(np.zeros(ends.shape), nothing, nothing, nothing, ends, np.zeros(ends.shape))


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
    return fit_walls(_find_boundary(_ends_of(_square(1.5))), _BELOW, _FAR)


def _true_axis() -> np.ndarray:
    return np.where(np.abs(np.cos(_AZIMUTH)) > np.abs(np.sin(_AZIMUTH)), 1, 2)


@pytest.mark.parametrize("view", (0, 1))
def test_a_rooms_four_walls_are_found(two_coloured, empty_room, room_axes, view):
    clue, room = two_coloured[0][view], empty_room.room
    centre = empty_room.posed.cam2world[view][:3, 3] @ room_axes.T
    low, high = (np.array(corner) @ room_axes.T - centre for corner in (room.low, room.high))
    walls = fit_walls(clue, float(high[0]), empty_room.posed.far)
    azimuth = ((np.arange(len(walls.axis)) + 0.5) / len(walls.axis) * 2 - 1) * math.pi
    along = np.stack((np.cos(azimuth), np.sin(azimuth)))
    reach = np.where(along > 0, high[1:, None], low[1:, None]) / along
    axis = reach.argmin(axis=0)
    offset = np.where(along > 0, high[1:, None], low[1:, None])[axis, np.arange(len(axis))]
    right = (walls.axis == axis + 1) & (walls.confidence > 0.9)
    assert right.mean() > 0.9
    # A pixel is 1.9 degrees here, a tenth of what is 2.8 m away.
    assert np.abs(walls.offset[right] / offset[right] - 1).max() < 0.12


def test_a_wall_bridges_what_no_end_shows(square_walls):
    ends = _ends_of(_square(1.5))
    ends[:, 120:124] = 0  # in the middle of a wall
    bridged = fit_walls(_find_boundary(ends), _BELOW, _FAR)
    assert len(np.unique(bridged.index[112:140])) == 1
    assert np.abs(bridged.offset[120:124] / 1.5 - 1).max() < 0.05
    assert (square_walls.axis == _true_axis()).mean() > 0.95
    assert (np.abs(np.abs(square_walls.offset) / 1.5 - 1) < 0.05).mean() > 0.95


def test_walls_do_not_end_where_the_panorama_does(square_walls):
    """The wall behind the camera begins at the last columns and goes on at the first."""
    assert square_walls.index[0] == square_walls.index[-1]
    assert square_walls.confidence[0] == square_walls.confidence[-1] > 0.9
    turned = fit_walls(_find_boundary(np.roll(_ends_of(_square(1.5)), _HEIGHT, axis=1)), _BELOW, _FAR)
    assert np.allclose(turned.offset, -np.roll(square_walls.offset, _HEIGHT))


@pytest.mark.parametrize("scale", (0.1, 10.0))
def test_a_larger_world_has_larger_walls(square_walls, scale):
    walls = fit_walls(_find_boundary(_ends_of(_square(1.5))), scale * _BELOW, scale * _FAR)
    assert (walls.axis == square_walls.axis).all()
    assert np.allclose(walls.offset[walls.axis > 0], scale * square_walls.offset[walls.axis > 0])


def test_without_ends_there_are_no_walls():
    walls = fit_walls(_find_boundary(np.zeros((_HEIGHT, 2 * _HEIGHT))), _BELOW, _FAR)
    assert (walls.axis == 0).all() and (walls.index == -1).all() and (walls.confidence == 0).all()


def test_narrow_walls_are_hardly_believed(square_walls):
    """A post 6 degrees wide in front of a wall."""
    distance = _square(1.5)
    distance[126:130] = 0.7
    posted = fit_walls(_find_boundary(_ends_of(distance)), _BELOW, _FAR)
    assert np.abs(posted.offset[128] / 0.7 - 1) < 0.1
    assert 0.3 < posted.confidence[128] < 0.8 < square_walls.confidence[128]


@pytest.mark.parametrize(
    ("distance", "agreed", "left"),
    ((1.0, True, 1.0), (0.6, True, 0.0), (0.6, False, 1.0)),
    ids=("agreed to be there", "agreed to be elsewhere", "nothing agreed"),
)
def test_a_wall_is_believed_unless_views_agree_on_another_surface(square_walls, room_axes, distance, agreed, left):
    rays = axis_components(room_axes, np.eye(3), _HEIGHT)
    walls = 1.5 / np.maximum(np.abs(rays[1]), np.abs(rays[2]))
    known = np.full(rays[0].shape, agreed)
    clues = _find_boundary(np.zeros((_HEIGHT, 2 * _HEIGHT)))
    believed = discount_contradicted(square_walls, clues, rays, 1 / (distance * walls), known)
    assert np.allclose(believed.confidence, left * square_walls.confidence, atol=1e-6)


def test_without_walls_nothing_is_believed_or_added(room_axes):
    clues = _find_boundary(np.zeros((_HEIGHT, 2 * _HEIGHT)))
    none = fit_walls(clues, _BELOW, _FAR)
    rays = axis_components(room_axes, np.eye(3), _HEIGHT)
    shape = rays[0].shape
    assert (discount_contradicted(none, clues, rays, np.ones(shape), np.ones(shape, bool)).confidence == 0).all()
    slopes, nothing = np.abs(rays).astype(np.float32), np.zeros((2, 1), np.float32)
    families = [HypothesisSet(slope, slope, nothing, np.zeros(shape, np.uint8)) for slope in (slopes[0], *slopes)]
    cost = np.zeros((*shape, 4), np.float32)
    apply_wall_bonus(cost, none, clues, families, rays, -1.0, 2.0)
    assert (cost == 0).all()


def test_the_wall_is_cheapest_between_the_floor_and_the_ceiling(square_walls, room_axes):
    rays = axis_components(room_axes, np.eye(3), _HEIGHT)
    shape, count, ceiling = rays[0].shape, 50, -1.0
    inverse = np.linspace(0.1, 2.0, count)
    families = [
        HypothesisSet(
            (inverse[0] * s).astype(np.float32), ((inverse[1] - inverse[0]) * s).astype(np.float32),
            np.zeros((2, count), np.float32), np.zeros(shape, np.uint8),
        )
        for s in (np.ones(shape), *np.abs(rays))
    ]  # fmt: skip
    cost = np.zeros((*shape, 4 * count), np.float32)
    clues = _find_boundary(np.zeros(shape))
    walls = dataclasses.replace(square_walls, confidence=np.ones(2 * _HEIGHT))
    apply_wall_bonus(cost, walls, clues, families, rays, ceiling, 2.0)
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
