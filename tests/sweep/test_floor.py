"""What one picture says of the floor."""

import math

import numpy as np
import pytest

from pansplat.sweep.cost import Family
from pansplat.sweep.floor import FloorClues, FloorConfig, add_clues
from pansplat.sweep.frame import main_directions


@pytest.mark.parametrize("view", (0, 1))
def test_what_is_painted_like_the_floor_looks_like_it(two_coloured, empty_room, view):
    clues, rays = two_coloured
    pose, depth = empty_room.posed.cam2world[view], empty_room.depths[view]
    height = rays[view][0] * depth + pose[1, 3]
    floor = np.abs(height - empty_room.room.high[1]) < 1e-3
    assert (clues[view].likeness[floor] > 0.2).mean() > 0.95
    assert (clues[view].likeness[~floor] < -0.2).mean() > 0.95


@pytest.mark.parametrize("view", (0, 1))
def test_the_floor_ends_where_the_walls_stand(two_coloured, empty_room, room_axes, view):
    clue, room = two_coloured[0][view], empty_room.room
    centre = empty_room.posed.cam2world[view][:3, 3] @ room_axes.T
    azimuths = len(clue.foot_angle)
    azimuth = ((np.arange(azimuths) + 0.5) / azimuths * 2 - 1) * math.pi  # of a panorama's columns
    low, high = (np.array(corner) @ room_axes.T - centre for corner in (room.low, room.high))
    along = np.stack((np.cos(azimuth), np.sin(azimuth)))
    walls = np.where(along > 0, high[1:, None], low[1:, None]) / along
    true = walls.min(axis=0)
    sure = clue.foot_strength > 0.5
    assert sure.mean() > 0.8
    assert np.median(np.abs(clue.foot_distance[sure] / true[sure] - 1)) < 0.05
    assert (np.abs(clue.foot_distance[sure] / true[sure] - 1) < 0.15).mean() > 0.95
    assert np.allclose(np.tan(clue.foot_angle) * clue.foot_distance, room.high[1] - centre[0], atol=1e-6)


def test_a_wall_in_the_floors_colours_stands_where_its_edge_is(empty_room, find_clues, room_axes):
    """One wall is painted like the floor, a little darker."""
    posed, room, images = empty_room.posed, empty_room.room, []
    wall = np.array(room.high)[2]
    for pose, depth, image in zip(posed.cam2world, empty_room.depths, posed.images, strict=True):
        rays = main_directions(room_axes, pose[:3, :3], image.shape[0])
        height, across = rays[0] * depth + pose[1, 3], rays[2] * depth + pose[2, 3]
        on_floor, on_wall = np.abs(height - room.high[1]) < 1e-3, np.abs(across - wall) < 1e-3
        dapples = (0.8 + 0.4 * image.mean(axis=2))[..., None]
        paint = np.where(on_floor[..., None], np.array((0.45, 0.3, 0.15)) * dapples, 0.85 * dapples)
        images.append(np.where(on_wall[..., None], np.array((0.345, 0.23, 0.115)) * dapples, paint))
    clues, rays = find_clues(posed, np.stack(images).clip(0, 1).astype(np.float32), room.high[1])
    assert clues is not None
    for clue, pose in zip(clues, posed.cam2world, strict=True):
        azimuth = ((np.arange(len(clue.foot_angle)) + 0.5) / len(clue.foot_angle) * 2 - 1) * math.pi
        facing = np.sin(azimuth) > 0.85  # the wall is across the third axis
        true = (wall - pose[2, 3]) / np.sin(azimuth[facing])
        right = np.abs(clue.foot_distance[facing] / true - 1) < 0.15
        sure = clue.foot_strength[facing] > 0.3
        assert sure.mean() > 0.3
        assert right[sure].mean() > 0.9


def test_without_a_floor_nothing_is_said(empty_room, find_clues):
    assert find_clues(empty_room.posed, empty_room.posed.images, math.inf)[0] is None


def test_one_paint_everywhere_says_nothing(empty_room, find_clues):
    clues, _ = find_clues(empty_room.posed, np.full_like(empty_room.posed.images, 0.5), empty_room.room.high[1])
    assert clues is not None
    for clue in clues:
        assert np.abs(clue.likeness).max() < 0.1
        assert clue.foot_strength.max() == 0


def test_where_the_floor_matches_badly_no_foot_is_believed(two_coloured, empty_room, find_clues):
    """The pictures of the two views, exchanged: what looks like floor does not match as floor."""
    posed = empty_room.posed
    images = np.stack((posed.images[0], np.random.default_rng(1).random(posed.images[1].shape).astype(np.float32)))
    clues, _ = find_clues(posed, images, empty_room.room.high[1])
    assert clues is not None
    believed = np.mean([clue.foot_strength for clue in clues])
    assert believed < 0.05 < np.mean([clue.foot_strength for clue in two_coloured[0]])


def test_a_foot_fades_where_the_picture_changes_above_it(room_axes):
    """A foot 30 degrees below the horizon, and an edge all around 10 degrees above the horizon."""
    rays = main_directions(room_axes, np.eye(3), 64)
    angle = ((np.arange(64) + 0.5) / 64 - 0.5) * math.pi
    change = np.repeat(np.where(angle < math.radians(-10), 2.0, 0.0)[:, None], 128, axis=1)
    nothing, end = np.zeros(128), np.full(128, math.radians(30))
    fading = FloorClues(np.zeros((64, 128)), end, nothing, nothing, np.zeros((64, 128)), change).fading(end, rays)
    down = np.degrees(np.arcsin(rays[0]))
    assert (fading[down > 31] == 0).all()
    assert np.allclose(fading[(down < 29) & (down > -8)], 1)
    assert np.allclose(fading[down < -12], math.exp(-2))


def test_clues_favour_the_floor_below_its_end_and_what_stands_there_above(room_axes):
    """A floor 1 m below that ends 2 m away: below the end it looks like floor, above it does not."""
    shape, count = (32, 64), 40
    rays = main_directions(room_axes, np.eye(3), 32)
    end = math.atan2(1, 2)
    like = np.where(np.arcsin(rays[0]) > end, 1, -1).astype(np.float32)
    clues = FloorClues(like, np.full(64, end), np.full(64, 2.0), np.ones(64), np.zeros(shape), np.zeros(shape))
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
