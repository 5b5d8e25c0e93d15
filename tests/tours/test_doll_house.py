"""The doll's house view keeps the rooms: no ceiling, nothing behind windows, no backs, and all rooms in the image."""

import dataclasses

import numpy as np
import pytest
import torch

from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.geometry.pose import quats_from_rotations
from pansplat.tours.doll_house import find_fronts, find_rooms, measure_roughness
from pansplat.tours.facts import TourFacts

LOW, HIGH = np.array((-2.0, -1.1, -3.0)), np.array((2.5, 1.5, 2.0))  # of the room around the first camera: x, y down, z


@pytest.fixture(scope="module")
def room() -> Scene:
    """What two cameras 1 m apart show of a box, whose wall at high x has a window with a garden 7 m behind it.

    The thin axis of each Gaussian is at right angles to its wall. The third camera is in a room of its own, 9 m ahead.
    """
    cameras = np.array(((0.0, 0.0, 0.0), (0.6, 0.0, -0.8), (0.0, 0.0, 9.0)))
    rays = fibonacci_directions(6000).double().numpy() + 1e-9
    means, rotations = [], []
    for camera in cameras:
        inside = camera - cameras[2] if camera[2] > 5 else camera
        distances = (np.where(rays > 0, HIGH, LOW) - inside) / rays
        wall = distances.argmin(axis=1)
        points = inside + distances.min(axis=1)[:, None] * rays
        behind_window = (wall == 0) & (points[:, 0] > 0) & (np.abs(points[:, 1]) < 0.5) & (np.abs(points[:, 2]) < 0.8)
        points[behind_window] = inside + 7 * rays[behind_window] / rays[behind_window, :1]
        means.append(points + camera - inside)
        rotations.append(np.eye(3)[:, np.stack((wall, (wall + 1) % 3, (wall + 2) % 3))].transpose(2, 0, 1))
    count = len(rays) * len(cameras)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(cameras), 1, 1)
    poses[:, :3, 3] = torch.from_numpy(cameras)
    gaussians = Gaussians(
        means=torch.from_numpy(np.concatenate(means)).float(),
        scales=torch.tensor((0.001, 0.05, 0.05)).expand(count, 3),
        quats=quats_from_rotations(torch.from_numpy(np.concatenate(rotations))).float(),
        opacities=torch.full((count,), 0.9),
        harmonics=torch.zeros(count, 1, 3),
        levels=torch.zeros(count, dtype=torch.uint8),
        views=torch.arange(len(cameras)).repeat_interleave(len(rays)),
    )
    return Scene(gaussians, poses, 0.3, 12.0, overlaps=((0, 1, 0.9), (2, 2, 1.0)))


def test_floor_and_walls_are_inside_and_ceiling_garden_and_coarse_levels_are_not(room: Scene) -> None:
    rooms = find_rooms(TourFacts(room))
    inside = rooms.find_inside(room.gaussians).numpy()
    means, first = room.gaussians.means.numpy(), (room.gaussians.views == 0).numpy()
    is_floor, is_ceiling = means[:, 1] > 1.4999, means[:, 1] < -1.09
    is_wall = (np.abs(means[:, 0] + 2) < 1e-3) & (means[:, 1] > -0.9)
    assert inside[first & (is_floor | is_wall)].all()
    assert not inside[is_ceiling].any() and not inside[means[:, 0] > 4].any()
    coarse = dataclasses.replace(room.gaussians, levels=torch.full_like(room.gaussians.levels, 2))
    assert not rooms.find_inside(coarse).any()
    assert rooms.list_level(1) == (0, 1) and rooms.list_level(2) == (2,)


def test_surfaces_of_a_storey_that_scatter_are_not_clear(room: Scene) -> None:
    random = torch.Generator().manual_seed(0)
    means, views = room.gaussians.means, room.gaussians.views
    centers = room.cam2world[views, :3, 3].float()
    factors = torch.where(views < 2, torch.exp(0.1 * torch.randn(len(means), generator=random)), 1.0)
    heap = dataclasses.replace(room.gaussians, means=centers + factors[:, None] * (means - centers))
    assert find_rooms(TourFacts(room)).is_clear == (True, True, True)
    assert find_rooms(TourFacts(dataclasses.replace(room, gaussians=heap))).is_clear == (False, False, True)


@pytest.mark.parametrize(("thickness", "expected"), [(0.0, 0.0), (1.0, 0.8)])
def test_a_plane_is_smooth_and_a_heap_is_rough(thickness: float, expected: float) -> None:
    places = np.random.default_rng(0).random((20_000, 3)) * (1, 1, thickness) + (3, -2, 5)
    assert measure_roughness(places) == pytest.approx(expected, abs=0.1)


def test_what_a_camera_saw_from_far_is_left_to_a_nearer_camera(room: Scene) -> None:
    far = dataclasses.replace(room.gaussians, views=torch.full_like(room.gaussians.views, 2))
    near = (room.gaussians.views == 0) & (room.gaussians.means.norm(dim=1) < 2.5)
    assert not find_rooms(TourFacts(room)).find_inside(far)[near].any()


def test_an_upper_storey_is_not_in_the_level_of_the_lower_one(room: Scene) -> None:
    poses, means = room.cam2world.clone(), room.gaussians.means.clone()
    poses[2, :3, 3] = torch.tensor((0.0, -2.8, 0.0))
    means[room.gaussians.views == 2] += torch.tensor((0.0, -2.8, -9.0))
    gaussians = dataclasses.replace(room.gaussians, means=means)
    above = dataclasses.replace(room, gaussians=gaussians, cam2world=poses, overlaps=((0, 1, 0.9), (0, 2, 0.5)))
    assert find_rooms(TourFacts(above)).list_level(0) == (0, 1) and find_rooms(TourFacts(above)).list_level(2) == (2,)


def test_from_its_own_camera_each_gaussian_shows_its_front(room: Scene) -> None:
    positions = room.cam2world[:, :3, 3]
    for view, position in enumerate(positions):
        own = room.gaussians.select(room.gaussians.views == view)
        assert find_fronts(own, positions, position).all()


def test_from_above_ceiling_and_near_walls_show_their_backs(room: Scene) -> None:
    fronts = find_fronts(room.gaussians, room.cam2world[:, :3, 3], torch.tensor((0.2, -8.0, -9.0))).numpy()
    means, first = room.gaussians.means.numpy(), (room.gaussians.views == 0).numpy()
    is_far_wall = (np.abs(means[:, 2] - 2) < 1e-3) & (np.abs(means[:, 0]) < 1)
    assert fronts[first & (means[:, 1] > 1.4999)].all() and fronts[first & is_far_wall & (means[:, 1] > -0.5)].all()
    is_ceiling = (means[:, 1] < -1.0999) & (means[:, 0] < 2.5)
    assert not fronts[first & is_ceiling].any() and not fronts[first & (np.abs(means[:, 2] + 3) < 1e-3)].any()
