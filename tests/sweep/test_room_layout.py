"""The floor boundary and the walls of single views."""

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


def _azimuths(count: int) -> np.ndarray:
    return ((np.arange(count) + 0.5) / count * 2 - 1) * math.pi


def _locate_walls(room, pose: np.ndarray, axes: np.ndarray, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed offsets (2, azimuths) of the walls that a camera faces, and their distances along the floor."""
    low, high = ((np.array(corner) - pose[:3, 3]) @ axes.T for corner in (room.low, room.high))
    along = np.stack((np.cos(azimuth), np.sin(azimuth)))
    offsets = np.where(along > 0, high[1:, None], low[1:, None])
    return offsets, offsets / along


def _sets(inverse: np.ndarray, rays: np.ndarray) -> list[HypothesisSet]:
    """Spheres, and planes across each axis, at the inverse distances."""
    shape, penalty = rays[0].shape, np.zeros((2, len(inverse)), np.float32)
    step = inverse[1] - inverse[0]
    return [
        HypothesisSet(
            (inverse[0] * s).astype(np.float32), (step * s).astype(np.float32), penalty, np.zeros(shape, np.uint8)
        )
        for s in (np.ones(shape), *np.abs(rays))
    ]


def test_pixels_in_the_floors_colour_have_a_high_score(brown_floor, empty_room, view):
    boundaries, rays = brown_floor
    pose, depth = empty_room.posed.cam2world[view], empty_room.depths[view]
    floor = np.abs(rays[view][0] * depth + pose[1, 3] - empty_room.room.high[1]) < 1e-3
    assert (boundaries[view].floor_score[floor] > 0.2).mean() > 0.95
    assert (boundaries[view].floor_score[~floor] < -0.2).mean() > 0.95


def test_the_floor_ends_at_the_walls(brown_floor, empty_room, room_axes, view):
    boundary, room, pose = brown_floor[0][view], empty_room.room, empty_room.posed.cam2world[view]
    true = _locate_walls(room, pose, room_axes, _azimuths(len(boundary.angle)))[1].min(axis=0)
    found = boundary.confidence > 0.5
    error = np.abs(boundary.distance[found] / true[found] - 1)
    assert found.mean() > 0.8
    assert np.median(error) < 0.05 and (error < 0.15).mean() > 0.95
    assert np.allclose(np.tan(boundary.angle) * boundary.distance, room.high[1] - pose[1, 3], atol=1e-6)


def test_a_wall_in_the_floors_colour_ends_the_floor_at_its_edge(empty_room, paint_floor, find_boundaries):
    """One wall is slightly darker than the floor."""
    posed, room = empty_room.posed, empty_room.room
    images = paint_floor(lambda points: np.abs(points[..., 2] - room.high[2]) < 1e-3)
    boundaries, _ = find_boundaries(posed, images, room.high[1])
    assert boundaries is not None
    for boundary, pose in zip(boundaries, posed.cam2world, strict=True):
        azimuth = _azimuths(len(boundary.angle))
        facing = np.sin(azimuth) > 0.85
        true = (room.high[2] - pose[2, 3]) / np.sin(azimuth[facing])
        right = np.abs(boundary.distance[facing] / true - 1) < 0.15
        found = boundary.confidence[facing] > 0.3
        assert found.mean() > 0.3
        assert right[found].mean() > 0.9


def test_without_a_floor_plane_there_are_no_boundaries(empty_room, find_boundaries):
    assert find_boundaries(empty_room.posed, empty_room.posed.images, math.inf)[0] is None


def test_a_room_of_one_colour_has_no_boundary(empty_room, find_boundaries):
    images = np.full_like(empty_room.posed.images, 0.5)
    boundaries, _ = find_boundaries(empty_room.posed, images, empty_room.room.high[1])
    assert boundaries is not None
    for boundary in boundaries:
        assert np.abs(boundary.floor_score).max() < 0.1
        assert boundary.confidence.max() == 0


def test_a_floor_that_does_not_match_has_no_boundary(brown_floor, empty_room, find_boundaries):
    """The second image is noise."""
    posed = empty_room.posed
    images = np.stack((posed.images[0], np.random.default_rng(1).random(posed.images[1].shape).astype(np.float32)))
    boundaries, _ = find_boundaries(posed, images, empty_room.room.high[1])
    assert boundaries is not None
    confidence = np.mean([boundary.confidence for boundary in boundaries])
    assert confidence < 0.05 < np.mean([boundary.confidence for boundary in brown_floor[0]])


def test_image_edges_attenuate_a_boundary(room_axes):
    """A boundary 30 degrees below the horizon, and an edge 10 degrees above the horizon."""
    rays = axis_components(room_axes, np.eye(3), 64)
    angle = ((np.arange(64) + 0.5) / 64 - 0.5) * math.pi
    edges = np.repeat(np.where(angle < math.radians(-10), 2.0, 0.0)[:, None], 128, axis=1)
    zeros, end = np.zeros(128), np.full(128, math.radians(30))
    boundary = FloorBoundary(np.zeros((64, 128)), end, zeros, zeros, np.zeros((64, 128)), edges)
    factor = boundary.attenuation(end, rays)
    down = np.degrees(np.arcsin(rays[0]))
    assert (factor[down > 31] == 0).all()
    assert np.allclose(factor[(down < 29) & (down > -8)], 1)
    assert np.allclose(factor[down < -12], math.exp(-2))


def test_costs_favour_the_floor_below_its_boundary_and_standing_surfaces_above(room_axes):
    """The floor is 1 m below the camera and ends 2 m away."""
    shape, count = (32, 64), 40
    rays = axis_components(room_axes, np.eye(3), 32)
    end = math.atan2(1, 2)
    score = np.where(np.arcsin(rays[0]) > end, 1, -1).astype(np.float32)
    boundary = FloorBoundary(score, np.full(64, end), np.full(64, 2.0), np.ones(64), np.zeros(shape), np.zeros(shape))
    inverse = np.linspace(0.1, 2.05, count)
    cost = np.zeros((*shape, 4 * count), np.float32)
    config = RoomLayoutConfig()
    is_floor = np.abs(1 / inverse - 1) < 0.03
    assert is_floor.sum() == 1
    apply_floor_costs(cost, boundary, _sets(inverse, rays), is_floor, rays, config)
    floor = count + int(is_floor.argmax())
    below, above = np.arcsin(rays[0]) > end + 0.05, (rays[0] > 0) & (np.arcsin(rays[0]) < end - 0.05)
    assert np.allclose(cost[below][:, floor], 0) and np.allclose(np.delete(cost[below], floor, axis=1), 0.3)
    assert np.allclose(cost[above][:, floor], config.not_floor_penalty)
    planes = cost[above].reshape(-1, 4, count)
    best = inverse[planes[:, 0].argmin(axis=-1)]
    expected = np.sqrt(1 - rays[0][above] ** 2) / 2
    assert np.abs(best / expected - 1).max() < 0.15
    assert planes[:, 0].min(axis=-1).max() < -0.5 * config.boundary_bonus * math.exp(-end / config.boundary_decay)
    assert (planes[:, 1] >= 0).all()  # horizontal planes do not stand on the floor
    sky = rays[0] < -0.9
    assert np.abs(cost[sky]).max() < config.boundary_bonus * math.exp(-(end + 1.1) / config.boundary_decay) + 1e-6


_HEIGHT = 128
_AZIMUTH = _azimuths(2 * _HEIGHT)
_CAMERA_HEIGHT, _FAR = 1.4, 8.0  # metres


def _boundary(score: np.ndarray) -> FloorBoundary:
    zeros = np.zeros(score.shape[1])
    return FloorBoundary(np.zeros(score.shape), zeros, zeros, zeros, score, np.zeros(score.shape))


_NO_BOUNDARY = _boundary(np.zeros((_HEIGHT, 2 * _HEIGHT)))


def _score_at(distance: np.ndarray) -> np.ndarray:
    """Score (rows, azimuths) of a floor boundary at distances (azimuths), one pixel high."""
    score = np.zeros((_HEIGHT, 2 * _HEIGHT))
    row = np.rint((np.arctan(_CAMERA_HEIGHT / distance) / math.pi + 0.5) * _HEIGHT - 1).astype(np.int64)
    score[row, np.arange(2 * _HEIGHT)] = 1
    return score


def _square(half: float) -> np.ndarray:
    """Distance (azimuths) of the walls of a square room from its centre."""
    return half / np.maximum(np.abs(np.cos(_AZIMUTH)), np.abs(np.sin(_AZIMUTH)))


@pytest.fixture(scope="module")
def rays(room_axes) -> np.ndarray:
    return axis_components(room_axes, np.eye(3), _HEIGHT)


@pytest.fixture(scope="module")
def square_walls() -> Walls:
    return fit_walls(_boundary(_score_at(_square(1.5))), _CAMERA_HEIGHT, _FAR)


def test_a_rooms_four_walls_are_found(brown_floor, empty_room, room_axes, view):
    boundary, pose = brown_floor[0][view], empty_room.posed.cam2world[view]
    walls = fit_walls(boundary, float(empty_room.room.high[1] - pose[1, 3]), empty_room.posed.far)
    offsets, reach = _locate_walls(empty_room.room, pose, room_axes, _azimuths(len(walls.axis)))
    axis = reach.argmin(axis=0)
    right = (walls.axis == axis + 1) & (walls.confidence > 0.9)
    assert right.mean() > 0.9
    # A pixel is 1.9 degrees here, a tenth of a distance of 2.8 m.
    assert np.abs(walls.offset[right] / offsets[axis, np.arange(len(axis))][right] - 1).max() < 0.12


def test_a_wall_bridges_a_gap_in_the_boundary(square_walls):
    score = _score_at(_square(1.5))
    score[:, 120:124] = 0  # in the middle of a wall
    bridged = fit_walls(_boundary(score), _CAMERA_HEIGHT, _FAR)
    assert len(np.unique(bridged.index[112:140])) == 1
    assert np.abs(bridged.offset[120:124] / 1.5 - 1).max() < 0.05
    true_axis = np.where(np.abs(np.cos(_AZIMUTH)) > np.abs(np.sin(_AZIMUTH)), 1, 2)
    assert (square_walls.axis == true_axis).mean() > 0.95
    assert (np.abs(np.abs(square_walls.offset) / 1.5 - 1) < 0.05).mean() > 0.95


def test_walls_continue_across_the_panoramas_border(square_walls):
    assert square_walls.index[0] == square_walls.index[-1]
    assert square_walls.confidence[0] == square_walls.confidence[-1] > 0.9
    turned = fit_walls(_boundary(np.roll(_score_at(_square(1.5)), _HEIGHT, axis=1)), _CAMERA_HEIGHT, _FAR)
    assert np.allclose(turned.offset, -np.roll(square_walls.offset, _HEIGHT))


@pytest.mark.parametrize("scale", (0.1, 10.0))
def test_scaling_the_world_scales_the_walls(square_walls, scale):
    walls = fit_walls(_boundary(_score_at(_square(1.5))), scale * _CAMERA_HEIGHT, scale * _FAR)
    assert (walls.axis == square_walls.axis).all()
    assert np.allclose(walls.offset[walls.axis > 0], scale * square_walls.offset[walls.axis > 0])


def test_narrow_walls_have_a_low_confidence(square_walls):
    """A post 6 degrees wide in front of a wall."""
    distance = _square(1.5)
    distance[126:130] = 0.7
    walls = fit_walls(_boundary(_score_at(distance)), _CAMERA_HEIGHT, _FAR)
    assert np.abs(walls.offset[128] / 0.7 - 1) < 0.1
    assert 0.3 < walls.confidence[128] < 0.8 < square_walls.confidence[128]


@pytest.mark.parametrize(
    ("distance", "consistent", "factor"),
    ((1.0, True, 1.0), (0.6, True, 0.0), (0.6, False, 1.0)),
    ids=("consistent with the wall", "consistent elsewhere", "inconsistent"),
)
def test_a_wall_is_dropped_where_views_agree_on_another_surface(square_walls, rays, distance, consistent, factor):
    walls = 1.5 / np.maximum(np.abs(rays[1]), np.abs(rays[2]))
    mask = np.full(rays[0].shape, consistent)
    discounted = discount_contradicted(square_walls, _NO_BOUNDARY, rays, 1 / (distance * walls), mask)
    assert np.allclose(discounted.confidence, factor * square_walls.confidence, atol=1e-6)


def test_without_a_boundary_there_are_no_walls_and_costs_do_not_change(rays):
    none = fit_walls(_NO_BOUNDARY, _CAMERA_HEIGHT, _FAR)
    assert (none.axis == 0).all() and (none.index == -1).all() and (none.confidence == 0).all()
    shape = rays[0].shape
    discounted = discount_contradicted(none, _NO_BOUNDARY, rays, np.ones(shape), np.ones(shape, bool))
    assert (discounted.confidence == 0).all()
    cost = np.zeros((*shape, 8), np.float32)
    apply_wall_bonus(cost, none, _NO_BOUNDARY, _sets(np.array((1.0, 2.0)), rays), rays, -1.0, 2.0)
    assert (cost == 0).all()


def test_the_wall_has_the_lowest_cost_between_the_floor_and_the_ceiling(square_walls, rays):
    shape, count, ceiling = rays[0].shape, 50, -1.0
    inverse = np.linspace(0.1, 2.0, count)
    cost = np.zeros((*shape, 4 * count), np.float32)
    walls = dataclasses.replace(square_walls, confidence=np.ones(2 * _HEIGHT))
    apply_wall_bonus(cost, walls, _NO_BOUNDARY, _sets(inverse, rays), rays, ceiling, 2.0)
    axis = np.where(np.abs(rays[1]) > np.abs(rays[2]), 1, 2)
    depth = 1.5 / np.maximum(np.abs(rays[1]), np.abs(rays[2]))
    height = rays[0] * depth  # downwards
    between = (height < _CAMERA_HEIGHT - 0.15) & (height > ceiling + 0.15)
    corner = np.abs(np.abs(rays[1]) - np.abs(rays[2])) < 0.1 * np.hypot(rays[1], rays[2])
    best = cost.argmin(axis=-1)[between & ~corner]
    assert (best // count == 1 + axis[between & ~corner]).all()
    assert np.abs(inverse[best % count] * 1.5 - 1).max() < 0.1
    assert cost.min(axis=-1)[between & ~corner].max() < -1
    assert (cost[(height > _CAMERA_HEIGHT + 0.25) | (height < ceiling - 0.15)] == 0).all()
    assert (cost[..., : 2 * count] == 0).all()  # spheres and horizontal planes are not walls
