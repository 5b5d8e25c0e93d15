"""Walls between panoramas."""

import dataclasses

import pytest
import torch

from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.tours.walls import find_walls


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
