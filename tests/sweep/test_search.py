"""The sweep's surfaces against a room of known depth, and their symmetries."""

import dataclasses

import cv2
import numpy as np
import pytest

from pansplat.sweep import search as module
from pansplat.sweep.search import SearchConfig, choose_nearest, observe, search
from pansplat.sweep.surface import PosedImages


def _search(posed: PosedImages, **changes) -> np.ndarray:
    """Inverse depths (v, h, 2h) from the posed images with other values of some fields."""
    found = search(observe(dataclasses.replace(posed, **changes), SearchConfig()))
    return np.stack([surface.inverse_depth for surface in found])


def _error(observed, view: int) -> np.ndarray:
    return np.abs(1 / (observed.surfaces[view].inverse_depth * observed.depths[view]) - 1)


@pytest.mark.parametrize(
    ("region", "min_accurate"),
    (((slice(None), np.arange(-3, 3)), 0.95), (slice(8), 0.97), (slice(-8, None), 0.97)),
    ids=("left and right border", "zenith", "nadir"),
)
def test_surfaces_are_accurate_at_the_borders_and_the_poles(empty_room, view, region, min_accurate):
    error = _error(empty_room, view)[region]
    assert np.median(error) < 0.015
    assert (error < 0.10).mean() > min_accurate


def test_a_box_is_in_front_of_the_walls(furnished_room, empty_room, view):
    truth, behind = furnished_room.depths[view], empty_room.depths[view]
    box = truth < 0.8 * behind
    found = 1 / furnished_room.surfaces[view].inverse_depth
    error = np.abs(found / truth - 1)
    # Within 4 degrees of its outline, 2 pixels, the surface is averaged (`make_whole`).
    inside, beside = (cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0 for mask in (box, ~box))
    assert inside.sum() > 150
    assert np.median(error[inside]) < 0.10
    assert (error[beside] < 0.10).mean() > 0.95


def test_surfaces_stay_within_the_depth_range(small_furnished_room):
    inverse = _search(small_furnished_room.posed, near=2.0, far=2.5)  # too narrow for the room
    near, far = 2.0 * module._NEAR_MARGIN, 2.5 * module._FAR_MARGIN
    assert inverse.min() >= np.float32(1 / far) and inverse.max() <= np.float32(1 / near)


def test_walls_beyond_far_are_found(empty_room, monkeypatch):
    beyond = empty_room.depths > 2.0
    assert beyond.mean() > 0.3
    medians = []
    for far_margin in (1.0, 10.0):
        monkeypatch.setattr(module, "_FAR_MARGIN", far_margin)
        found = _search(empty_room.posed, far=1.8)
        error = np.abs(1 / (found * empty_room.depths) - 1)
        medians.append(np.median(error[beyond]))
        assert np.median(error[~beyond]) < 0.03
    assert medians[0] > 0.03 > medians[1]


@pytest.mark.slow
def test_rolling_the_panoramas_rolls_the_surfaces(empty_room, turn):
    posed, columns = empty_room.posed, 96  # by half a turn the crops in which segments are found stay the same
    turned = posed.cam2world.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ turn("y", -360 * columns / posed.images.shape[2])
    images = np.roll(posed.images, columns, axis=2)
    rolled = np.roll(_search(posed, images=images, cam2world=turned), -columns, axis=2)
    change = np.abs(rolled / empty_room.inverse_depths - 1)
    assert np.median(change) < 1e-3
    assert (change < 0.02).mean() > 0.97


def test_rotating_the_world_changes_no_surface(small_room, turn):
    motion = np.eye(4)
    motion[:3, :3] = turn("y", 71) @ turn("x", 35) @ turn("z", -21)
    inverse = _search(small_room.posed, cam2world=motion @ small_room.posed.cam2world)
    assert ((np.abs(inverse / small_room.inverse_depths - 1) < 0.01).mean(axis=(1, 2)) > 0.95).all()


def test_more_views_are_no_worse_than_two(small_furnished_room, three_views):
    two, three = ((_error(observed, 0) < 0.10).mean() for observed in (small_furnished_room, three_views))
    assert three > two - 0.01


def test_coincident_cameras_give_the_middle_of_the_range(small_room):
    inverse = _search(small_room.posed, cam2world=np.stack([small_room.posed.cam2world[0]] * 2))
    assert np.allclose(inverse, 0.5 * (1 / 0.5 + 1 / 8.0))


def test_the_nearest_views_of_a_grid_do_not_depend_on_the_rounding_of_its_poses():
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, :3:2, 3] = [divmod(i, 3) for i in range(9)]
    noise = np.random.default_rng(0).normal(0, 1e-12, poses.shape)
    assert choose_nearest(poses + noise, 2, 0.1) == choose_nearest(poses, 2, 0.1)
