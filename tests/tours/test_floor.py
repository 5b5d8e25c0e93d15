"""The floor under cameras, and floor plans."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.gaussians.scene import Scene, SceneTour
from pansplat.inputs.panorama_sets import Panorama
from pansplat.tours import floor
from pansplat.tours.floor import find_floor_outline
from pansplat.tours.graph import TourGraph
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.surfaces import find_surfaces


@pytest.fixture(scope="module")
def room_scene() -> Scene:
    """Gaussians on the surfaces of a room 4 m wide and 6 m long, around a camera 1.5 m over its floor; z is up."""
    pose = place_cameras((0.5, 0.0, 1.5))
    pose[:, :3, :3] = torch.tensor(((1.0, 0, 0), (0, 0, 1), (0, -1, 0)))
    low, high = torch.tensor((-1.0, -2.0, 0.0)), torch.tensor((3.0, 4.0, 2.5))
    return Scene(make_balls(see_box(low, high, pose[0, :3, 3], 20000), 0.02, 1.0), pose, 0.45, 10.0)


def test_the_floor_of_a_room_ends_at_its_walls(room_scene):
    level = room_scene.cam2world[0, :3, :3].numpy()
    (surfaces,) = find_surfaces(room_scene, level)
    outline = find_floor_outline(surfaces.samples, surfaces.center[[0, 2]])
    assert outline.camera_height == pytest.approx(1.5, abs=0.01)
    inside = (outline.corners - (-1, -2)) / (4, 6)
    border = np.minimum(inside, 1 - inside).min(axis=1)
    assert np.abs(border).max() < 0.04, "all corners are near a wall"
    scene = Scene(room_scene.gaussians.select(torch.arange(20)), room_scene.cam2world, 0.45, 10.0)
    (few,) = find_surfaces(scene, level)
    assert find_floor_outline(few.samples, np.zeros(2)) is None and floor.find_floor(few.samples) is None
    assert floor.find_floor(surfaces.samples) == outline.camera_height
    assert floor.choose_camera_height((1.0, None, 1.4, 1.6), 10.0) == 1.4
    assert floor.choose_camera_height((None,), 10.0) == 1.5


def test_storeys_are_levels_of_cameras_and_stairs_are_in_none():
    assert floor.find_storeys(np.empty(0)) == []
    assert floor.find_storeys(np.array((1.5, 1.2, 1.52, 1.15))) == [[0, 1, 2, 3]], "two steps of a room"
    assert floor.find_storeys(np.array((1.5, 1.5, 2.5))) == [[0, 1]], "one on the stairs"
    assert floor.find_storeys(np.array((1.5, 2.5))) == [[0, 1]], "nothing states which one is on stairs"
    assert floor.find_storeys(np.array((2.9, 0.0, 0.3, 1.0, 3.0, 2.0, 0.1))) == [[1, 2, 6], [0, 4]]
    assert floor.find_storeys(np.array((0.0, 1.4, 0.05, 2.9))) == [[0, 2], [3]], "one alone between two levels"
    assert floor.find_storeys(np.array((1.0, 2.0, 0.0))) == [[2], [1]]
    assert floor.find_storeys(np.array((0.0, 0.5, 1.0, 1.1, 6.0, 6.0))) == [[2, 3], [4, 5]]


def _make_two_storeys(room_scene: Scene) -> TourGraph:
    """Two panoramas of a lower storey and two of an upper one, one on the stairs, and one of another world."""
    panoramas = []
    for number, (rise, world) in enumerate(((0, 0), (0.1, 0), (1.6, 0), (2.9, 0), (2.8, 0), (1.4, 1))):
        pose = room_scene.cam2world[0].clone()
        pose[2, 3] += rise  # z is up
        pose[0, 3] += 0.2 * number
        panoramas.append(Panorama(str(number), Path(str(number)), pose, world=world))
    return TourGraph("", Path(), tuple(panoramas), 0.45, 10.0)


def test_other_storeys_are_those_of_the_same_world_at_another_level(room_scene):
    tour = _make_two_storeys(room_scene)
    assert floor.find_other_storeys(tour, tour.positions[0] + (0, 0, 0.3)) == {2, 3, 4}
    assert floor.find_other_storeys(tour, tour.positions[4]) == {0, 1}, "the stairs are nearer to the upper storey"
    assert floor.find_other_storeys(tour, tour.positions[2]) == {0, 1}
    assert floor.find_other_storeys(tour, tour.positions[5]) == frozenset(), "levels of two worlds cannot be compared"


def test_panoramas_that_are_not_placed_neither_add_nor_merge_storeys(room_scene):
    heights = torch.tensor([0.0, 0.0, 0.0, 2.3, 2.3, 2.3, *[1.15] * 5], dtype=torch.float64)
    poses = room_scene.cam2world[:1].repeat(len(heights), 1, 1)
    poses[:, 2, 3] += heights  # z is up
    edges = (*((k, k + 1, 0.5) for k in range(5)), *((k, k, 1.0) for k in range(6, 11)))
    tour = make_graph(dataclasses.replace(room_scene, cam2world=poses, names=(), tour=SceneTour(edges)))
    assert floor.assign_storeys(tour) == [0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0]
    assert floor.find_other_storeys(tour, tour.positions[0]) == {3, 4, 5}
    assert floor.find_other_storeys(tour, tour.positions[8]) == frozenset(), "it has no storey"


def _floor_of(*boxes: tuple[float, float, float, float]) -> np.ndarray:
    """Places on a floor 1.5 m below a camera at the origin, in boxes of low and high right, low and high forward."""
    grids = [np.meshgrid(np.arange(a, b, 0.03), np.arange(c, d, 0.03)) for a, b, c, d in boxes]
    flat = np.concatenate([np.stack([axis.ravel() for axis in grid], axis=1) for grid in grids])
    blocked = np.zeros(len(flat), bool)
    for step in np.linspace(0.02, 0.98, 49):  # behind a wall
        x, y = (flat * step).T
        blocked |= ~np.any([(a <= x) & (x <= b) & (c <= y) & (y <= d) for a, b, c, d in boxes], axis=0)
    return np.insert(flat[~blocked], 1, 1.5, axis=1)


def test_a_floor_ends_at_a_door_though_it_is_seen_beyond():
    room, door, beyond = (-2.0, 1.5, -1.5, 2.0), (1.5, 1.7, -0.3, 0.35), (1.7, 6.0, -2.0, 3.0)
    outline = find_floor_outline(_floor_of(room, door, beyond), np.zeros(2))
    assert outline.camera_height == pytest.approx(1.5, rel=0.01)
    corners = outline.corners
    assert corners[:, 0].max() < 2.0 and corners.min(axis=0) == pytest.approx((-2.0, -1.5), abs=0.1)


def test_rays_through_several_wide_openings_are_no_outline():
    wide = [(0.5, 6.0, -0.5, 0.5), (-6.0, -0.5, -0.5, 0.5), (-0.5, 0.5, 0.5, 6.0), (-0.5, 0.5, -6.0, -0.5)]
    assert find_floor_outline(_floor_of((-0.9, 0.9, -0.9, 0.9), *wide), np.zeros(2)) is None
    l_room = _floor_of((-0.9, 4.0, -0.9, 0.9), (-0.9, 0.9, -0.9, 4.0))
    assert find_floor_outline(l_room, np.zeros(2)) is not None
