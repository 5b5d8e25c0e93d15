"""The benchmark scenes have the paper's counts, and their Gaussians lie on surfaces."""

import math

import pytest
import torch

from pansplat.bench.scenes import full_lattice_room, lattice_room_size, lift_depth, make_room_cameras
from pansplat.data.views import Views
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import rasterize

HEIGHT = 64


def test_counts_are_those_of_the_paper():
    assert len(full_lattice_room(256)) == lattice_room_size(256) == 221_642
    assert lattice_room_size(512) == 886_580 and lattice_room_size(2048) == 14_185_312
    assert len(full_lattice_room(32, views=1)) * 2 == len(full_lattice_room(32, views=2))


def test_scenes_are_deterministic():
    first, second = full_lattice_room(32, degree=2), full_lattice_room(32, degree=2)
    assert torch.equal(first.means, second.means) and torch.equal(first.harmonics, second.harmonics)
    assert not torch.equal(first.opacities, full_lattice_room(32, degree=2, seed=1).opacities)


@pytest.mark.parametrize("degree", [0, 1, 4])
def test_fields_are_float32_of_the_degree(degree):
    room = full_lattice_room(16, degree=degree)
    assert room.degree == degree
    assert room.means.dtype == room.scales.dtype == room.harmonics.dtype == torch.float32


def test_discs_are_half_a_pixel_to_a_pixel_wide_across_the_line_of_sight():
    room = full_lattice_room(64)
    distance = (room.means - make_room_cameras(2)[room.views.long(), :3, 3]).norm(dim=1)
    pixels = room.scales[:, 1] / distance / (math.pi / 64 * 2.0**room.levels)
    assert float(pixels.min()) > 0.4999 and float(pixels.max()) < 1.0001
    assert float(room.opacities.min()) >= 0.3 and float(room.opacities.max()) <= 0.95


def test_discs_lie_flat_on_surfaces_along_the_axes():
    room = full_lattice_room(32)
    normal = rotations_from_quats(room.quats.double())[:, :, 2].abs()
    assert torch.allclose(normal.amax(dim=1), torch.ones(len(room), dtype=torch.float64), atol=1e-6)


def test_furniture_hides_the_walls():
    room = full_lattice_room(64, views=1)
    ahead = room.means[(room.means[:, 0].abs() < 0.2) & (room.means[:, 1].abs() < 0.9) & (room.means[:, 2] > 1)]
    assert float(ahead[:, 2].min()) < 2.1 and float(ahead[:, 2].max()) > 3.8


def test_heights_that_are_not_multiples_of_8_are_refused():
    with pytest.raises(ValueError, match="multiple of 8, got 20"):
        full_lattice_room(20)


def views_in_a_sphere(radius: float = 2.0) -> Views:
    """Two rotated panoramas from the centre of a sphere whose colours are linear in the direction."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, :3] = rotations_from_quats(torch.tensor((0.6, 0.0, 0.8, 0.0), dtype=torch.float64))
    directions = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64)
    images = torch.stack([(0.5 + 0.4 * directions @ pose[:3, :3].T).permute(2, 0, 1) for pose in poses]).float()
    depths = torch.full((2, HEIGHT, 2 * HEIGHT), radius)
    return Views(images, poses, torch.ones_like(depths, dtype=torch.bool), 0.5, 5.0, ("a", "b"), depths)


def test_every_lattice_point_is_lifted_to_the_surface():
    gaussians = lift_depth(views_in_a_sphere()).gaussians
    assert len(gaussians) == lattice_room_size(HEIGHT)
    assert torch.allclose(gaussians.means.norm(dim=1), torch.full((len(gaussians),), 2.0))


def test_lifted_discs_lie_flat_on_the_surface():
    gaussians = lift_depth(views_in_a_sphere()).gaussians
    normals = rotations_from_quats(gaussians.quats.double())[:, :, 2]
    cosines = (normals * gaussians.means.double() / 2).sum(dim=1).abs()
    # Normals from neighbouring pixels are exact except near the poles.
    assert cosines.median() > 0.999 and cosines.min() > math.cos(math.radians(20))


def test_a_scene_from_depth_looks_like_its_images():
    views = views_in_a_sphere()
    scene = lift_depth(views)
    for image, pose in zip(views.images, views.cam2world, strict=True):
        rendered = rasterize(scene.gaussians, pose, size=(HEIGHT, 2 * HEIGHT)).color
        error = (rendered - image).abs()  # colours span 0.8
        assert error.mean() < 0.03 and error.max() < 0.1


def test_unknown_depth_is_replaced_by_the_median():
    views = views_in_a_sphere()
    views.depths[0, 10:20, 30:50] = 0
    assert torch.allclose(lift_depth(views).gaussians.means.norm(dim=1), torch.tensor(2.0))


def test_views_without_depth_are_refused():
    views = views_in_a_sphere()
    without = Views(views.images, views.cam2world, views.masks, views.near, views.far, views.names)
    with pytest.raises(InputError, match="needs a depth map"):
        lift_depth(without)
