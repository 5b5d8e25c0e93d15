"""Edges whose flights would be poor, and walls between panoramas."""

import dataclasses

import numpy as np
import pytest
import torch

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.tours.edges import find_poor_edges, find_walls, judge_edges, measure_way
from pansplat.tours.surfaces import locate_surfaces


@pytest.fixture(scope="module")
def room() -> Scene:
    """Two exact views of the room of boxes, a metre apart."""
    return Scene(full_lattice_room(128), make_room_cameras(2), 0.1, 10.0)


def bend(room: Scene, factor: float) -> Scene:
    """The room whose second view shows all surfaces at other distances."""
    gaussians, center = room.gaussians, room.cam2world[1, :3, 3].float()
    moved = center + factor * (gaussians.means - center)
    means = moved.where((gaussians.views == 1)[:, None], gaussians.means)
    return dataclasses.replace(room, gaussians=dataclasses.replace(gaussians, means=means))


def measure(scene: Scene) -> tuple[float, float]:
    first, second = (locate_surfaces(scene, view, np.eye(3), min_opacity=0.5) for view in (0, 1))
    return measure_way(first, second, (scene.cam2world[1] - scene.cam2world[0])[:3, 3].numpy())


def test_surfaces_of_one_room_agree_and_bent_ones_do_not(room: Scene) -> None:
    agreeing, nearest = measure(room)
    assert agreeing < 0.05 and nearest == 1
    shares = [measure(bend(room, factor))[0] for factor in (1.05, 1.3)]
    assert agreeing <= shares[0] < 0.5 < shares[1]
    first, second = (locate_surfaces(room, view, np.eye(3), min_opacity=0.5) for view in (0, 1))
    way = np.array((1.0, 0, 0))
    assert measure_way(3 * first, 3 * second, 3 * way) == pytest.approx((agreeing, nearest), abs=0.02), "any unit"
    close = np.concatenate([first, (0.5, 0, 0) + 0.1 * first / np.linalg.norm(first, axis=1)[:, None]])
    assert measure_way(close, second, way)[1] == pytest.approx(0.1, abs=0.02)
    assert measure_way(first[:0], second, way) == (1.0, 0.0)


def test_an_edge_is_poor_if_its_surfaces_disagree(room: Scene) -> None:
    edges = [(4, 7), (4, 4), (4, 9)]
    small = bend(room, 0.35)
    (good,), (bad,) = (judge_edges(scene, (4, 7), edges).items() for scene in (room, small))
    assert good[0] == bad[0] == (4, 7) and 0 < good[1] < bad[1] - 0.2
    assert find_poor_edges(room, (4, 7), edges) == () and find_poor_edges(small, (4, 7), edges) == ((4, 7),)


@pytest.mark.parametrize(
    ("sizes", "is_wall"), [((0.3, 0.3), True), ((0.3, 2.0), False), ((2.0, 0.3), False), ((2.0, 2.0), False)]
)
def test_a_wall_is_what_both_cameras_see_in_front_of_the_other(sizes, is_wall):
    """Each camera is in a room of boxes, which ends before the other camera or contains it."""
    poses, parts = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), []
    room, center = full_lattice_room(64, views=1), make_room_cameras(1)[0, :3, 3].float()
    for view, size in enumerate(sizes):
        poses[view, 0, 3] = 2.0 * view
        own = room.scaled(size, center)
        means = own.means - center + poses[view, :3, 3].float()
        parts.append(dataclasses.replace(own, means=means, views=torch.full_like(own.views, view)))
    scene = Scene(Gaussians.cat(parts), poses, 0.1, 10.0)
    edges = ((3, 5), (5, 7), (3, 3))
    assert find_walls(scene, (3, 5), edges) == ([(3, 5)] if is_wall else [])
