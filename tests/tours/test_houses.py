"""The houses of a scene: their rooms, and which panoramas are in one house."""

import dataclasses

import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.gaussians.scene import Scene, SceneTour
from pansplat.tours.facts import TourFacts
from pansplat.tours.houses import find_houses

LOW, HIGH = np.array((-2.0, -1.1, -3.0)), np.array((2.5, 1.5, 2.0))  # of the room around a camera: x, y down, z
PLACES = ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (10.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def rooms() -> Scene:
    """Three rooms of a storey, with a camera each."""
    seen = [see_box(LOW + place, HIGH + place, np.array(place), 20_000) for place in PLACES]
    views = torch.arange(3).repeat_interleave(20_000)
    gaussians = make_balls(torch.cat(seen), 0.02, views=views)
    return Scene(gaussians, place_cameras(*PLACES), 0.3, 12.0, tour=SceneTour(((0, 1, 0.5), (1, 2, 0.5))))


def _without_walls(scene: Scene, views: tuple[int, ...]) -> Scene:
    """The scene, in which some views show a small part of their room."""
    gone = torch.isin(scene.gaussians.views, torch.tensor(views)) & (scene.gaussians.means[:, 2] < 1.9)
    return dataclasses.replace(scene, gaussians=scene.gaussians.select(~gone))


def test_rooms_are_those_of_the_plan(rooms: Scene) -> None:
    found = find_houses(TourFacts(rooms))
    assert [room.panoramas for room in found.plan.rooms] == [(0,), (1,), (2,)] and found.views == ((0, 1, 2),)
    assert [room.shape.area for room in found.plan.rooms] == pytest.approx([22.5] * 3, rel=0.02)
    assert found.floors == pytest.approx([1.5] * 3, rel=0.02) and found.ceilings == pytest.approx([1.1] * 3, rel=0.02)


def test_a_house_with_walls_of_fewer_than_half_of_its_rooms_is_hidden(rooms: Scene) -> None:
    half = find_houses(TourFacts(_without_walls(rooms, (1,))))
    assert half.views == ((0, 1, 2),) and [room.panoramas for room in half.plan.rooms] == [(0,), (2,), (1,)]
    assert find_houses(TourFacts(_without_walls(rooms, (1, 2)))).views == ()


def test_an_upper_storey_is_another_house(rooms: Scene) -> None:
    poses = rooms.cam2world.clone()
    poses[2, :3, 3] = torch.tensor((0.0, -2.8, 0.0))
    shift = torch.where((rooms.gaussians.views == 2)[:, None], torch.tensor((-10.0, -2.8, 0.0)), 0.0)
    gaussians = dataclasses.replace(rooms.gaussians, means=rooms.gaussians.means + shift)
    above = dataclasses.replace(rooms, gaussians=gaussians, cam2world=poses)
    assert find_houses(TourFacts(above)).views == ((0, 1), (2,))
