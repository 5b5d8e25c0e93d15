"""What one picture says of the floor."""

import math

import numpy as np
import pytest

from pansplat.model.sweep.cost import Family, MatchingConfig, View
from pansplat.model.sweep.floor import FloorClues, FloorConfig, add_clues, find_floor
from pansplat.model.sweep.frame import main_directions
from pansplat.model.sweep.planes import no_support

_AXES = np.array(((0.0, 1, 0), (1, 0, 0), (0, 0, 1)))  # down and the room's two wall normals
_HEIGHT = 96


def _found(posed, images, floor: float) -> tuple[list[FloorClues] | None, list[np.ndarray]]:
    """Clues of pictures and their rays along the room's axes; the floor at an offset, metres."""
    rays = [main_directions(_AXES, pose[:3, :3], images.shape[1]) for pose in posed.cam2world]
    views = [
        View(np.ascontiguousarray(image, np.float32), mask, np.ascontiguousarray(ray[0], np.float32))
        for image, mask, ray in zip(images, posed.masks, rays, strict=True)
    ]
    nothing = no_support(posed.cam2world, _AXES, posed.near, posed.far)
    support = type(nothing)(**{**vars(nothing), "floor_ceiling": (floor - nothing.origin[1], -math.inf)})
    return find_floor(views, rays, posed.cam2world, support, MatchingConfig()), rays


@pytest.fixture(scope="module")
def two_coloured(empty_room):
    """The room with a dappled brown floor and dappled white walls, its clues, and its rays."""
    posed, floor = empty_room.posed, empty_room.room.high[1]
    images = []
    for pose, depth, image in zip(posed.cam2world, empty_room.depths, posed.images, strict=True):
        rays = main_directions(_AXES, pose[:3, :3], _HEIGHT)[0]
        on_floor = np.abs(rays * depth + pose[1, 3] - floor) < 1e-3
        paint = np.where(on_floor[..., None], (0.45, 0.3, 0.15), (0.85, 0.85, 0.85))
        images.append(paint * (0.8 + 0.4 * image.mean(axis=2, keepdims=True)))
    clues, rays = _found(posed, np.stack(images).clip(0, 1).astype(np.float32), floor)
    assert clues is not None
    return clues, rays


@pytest.mark.parametrize("view", (0, 1))
def test_what_is_painted_like_the_floor_looks_like_it(two_coloured, empty_room, view):
    clues, rays = two_coloured
    pose, depth = empty_room.posed.cam2world[view], empty_room.depths[view]
    height = rays[view][0] * depth + pose[1, 3]
    floor = np.abs(height - empty_room.room.high[1]) < 1e-3
    assert (clues[view].likeness[floor] > 0.2).mean() > 0.95
    assert (clues[view].likeness[~floor] < -0.2).mean() > 0.95


@pytest.mark.parametrize("view", (0, 1))
def test_the_floor_ends_where_the_walls_stand(two_coloured, empty_room, view):
    clue, room = two_coloured[0][view], empty_room.room
    centre = empty_room.posed.cam2world[view][:3, 3] @ _AXES.T
    azimuth = ((np.arange(2 * _HEIGHT) + 0.5) / (2 * _HEIGHT) * 2 - 1) * math.pi  # of a panorama's columns
    low, high = (np.array(corner) @ _AXES.T - centre for corner in (room.low, room.high))
    along = np.stack((np.cos(azimuth), np.sin(azimuth)))
    walls = np.where(along > 0, high[1:, None], low[1:, None]) / along
    true = walls.min(axis=0)
    sure = clue.foot_strength > 0.5
    assert sure.mean() > 0.8
    assert np.median(np.abs(clue.foot_distance[sure] / true[sure] - 1)) < 0.05
    assert (np.abs(clue.foot_distance[sure] / true[sure] - 1) < 0.15).mean() > 0.95
    assert np.allclose(np.tan(clue.foot_angle) * clue.foot_distance, room.high[1] - centre[0], atol=1e-6)


def test_without_a_floor_nothing_is_said(empty_room):
    assert _found(empty_room.posed, empty_room.posed.images, math.inf)[0] is None


def test_one_paint_everywhere_says_nothing(empty_room):
    clues, _ = _found(empty_room.posed, np.full_like(empty_room.posed.images, 0.5), empty_room.room.high[1])
    assert clues is not None
    for clue in clues:
        assert np.abs(clue.likeness).max() < 0.1
        assert clue.foot_strength.max() == 0


def test_where_the_floor_matches_badly_no_foot_is_believed(two_coloured, empty_room):
    """The pictures of the two views, exchanged: what looks like floor does not match as floor."""
    posed = empty_room.posed
    images = np.stack((posed.images[0], np.random.default_rng(1).random(posed.images[1].shape).astype(np.float32)))
    clues, _ = _found(posed, images, empty_room.room.high[1])
    assert clues is not None
    believed = np.mean([clue.foot_strength for clue in clues])
    assert believed < 0.05 < np.mean([clue.foot_strength for clue in two_coloured[0]])


def test_clues_favour_the_floor_below_its_end_and_what_stands_there_above():
    """A floor 1 m below that ends 2 m away: below the end it looks like floor, above it does not."""
    shape, count = (32, 64), 40
    rays = main_directions(_AXES, np.eye(3), 32)
    end = math.atan2(1, 2)
    like = np.where(np.arcsin(rays[0]) > end, 1, -1).astype(np.float32)
    clues = FloorClues(like, np.full(64, end), np.full(64, 2.0), np.ones(64))
    inverse = np.linspace(0.1, 2.05, count)
    slopes = [np.ones(shape), *np.abs(rays)]
    families = [
        Family(
            (inverse[0] * s).astype(np.float32), ((inverse[1] - inverse[0]) * s).astype(np.float32),
            np.zeros((2, count), np.float32), np.zeros(shape, np.uint8),
        )
        for s in slopes
    ]  # fmt: skip
    cost = np.zeros((*shape, 4 * count), np.float32)
    config = FloorConfig()
    is_floor = np.abs(1 / inverse - 1) < 0.03
    assert is_floor.sum() == 1
    add_clues(cost, clues, families, is_floor, rays, config)
    floor = count + int(is_floor.argmax())
    below, above = np.arcsin(rays[0]) > end + 0.05, (rays[0] > 0) & (np.arcsin(rays[0]) < end - 0.05)
    assert np.allclose(cost[below][:, floor], 0) and np.allclose(np.delete(cost[below], floor, axis=1), 0.3)
    assert np.allclose(cost[above][:, floor], config.unlike_penalty)
    planes = cost[above].reshape(-1, 4, count)
    best = inverse[planes[:, 0].argmin(axis=-1)]
    wanted = np.sqrt(1 - rays[0][above] ** 2) / 2
    assert np.abs(best / wanted - 1).max() < 0.15
    assert planes[:, 0].min(axis=-1).max() < -0.5 * config.foot_bonus * math.exp(-end / config.foot_reach)
    assert (planes[:, 1] >= 0).all()  # what is level does not stand
    sky = rays[0] < -0.9
    assert np.abs(cost[sky]).max() < config.foot_bonus * math.exp(-(end + 1.1) / config.foot_reach) + 1e-6
