"""A scene made of known depth has the paper's counts, and looks like the place."""

import math

import pytest
import torch

from pansplat.bench.lifted import lift_depth
from pansplat.bench.scenes import lattice_room_size
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import rasterize

HEIGHT = 64


def in_a_ball(radius: float = 2.0) -> Views:
    """Panoramas from the centre of a ball whose wall is coloured by direction, one camera turned against the other."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, :3] = rotations_from_quats(torch.tensor((0.6, 0.0, 0.8, 0.0), dtype=torch.float64))
    directions = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64)
    images = torch.stack([(0.5 + 0.4 * directions @ pose[:3, :3].T).permute(2, 0, 1) for pose in poses]).float()
    depths = torch.full((2, HEIGHT, 2 * HEIGHT), radius)
    return Views(images, poses, torch.ones_like(depths, dtype=torch.bool), 0.5, 5.0, ("a", "b"), depths)


def test_every_lattice_point_becomes_a_gaussian_on_the_surface():
    gaussians = lift_depth(in_a_ball()).gaussians
    assert len(gaussians) == lattice_room_size(HEIGHT)
    assert torch.allclose(gaussians.means.norm(dim=1), torch.full((len(gaussians),), 2.0))


def test_discs_lie_flat_on_the_surface():
    gaussians = lift_depth(in_a_ball()).gaussians
    normals = rotations_from_quats(gaussians.quats.double())[:, :, 2]
    cosines = (normals * gaussians.means.double() / 2).sum(dim=1).abs()
    # Normals are taken between pixels: a few degrees of a coarse pixel at the poles, none elsewhere.
    assert cosines.median() > 0.999 and cosines.min() > math.cos(math.radians(20))


def test_the_place_looks_like_its_pictures():
    views = in_a_ball()
    scene = lift_depth(views)
    for image, pose in zip(views.images, views.cam2world, strict=True):
        drawn = rasterize(scene.gaussians, pose, size=(HEIGHT, 2 * HEIGHT)).color
        error = (drawn - image).abs()  # colours span 0.8
        assert error.mean() < 0.03 and error.max() < 0.1


def test_unknown_depth_is_taken_to_be_the_median():
    views = in_a_ball()
    views.depths[0, 10:20, 30:50] = 0
    assert torch.allclose(lift_depth(views).gaussians.means.norm(dim=1), torch.tensor(2.0))


def test_views_without_depth_are_refused():
    views = in_a_ball()
    without = Views(views.images, views.cam2world, views.masks, views.near, views.far, views.names)
    with pytest.raises(InputError, match="needs a depth map"):
        lift_depth(without)
