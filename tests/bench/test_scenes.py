"""The benchmark scenes have the paper's counts, and their Gaussians lie on surfaces."""

import math

import pytest
import torch

from pansplat.bench.scenes import full_lattice_room, lattice_room_size, make_room_cameras
from pansplat.geometry.pose import rotations_from_quats


def test_counts_are_those_of_the_paper():
    assert len(full_lattice_room(64)) == lattice_room_size(64) == 13_848
    assert [lattice_room_size(height) for height in (256, 512, 2048)] == [221_642, 886_580, 14_185_312]
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
    room = full_lattice_room(32)
    distance = (room.means - make_room_cameras(2)[room.views.long(), :3, 3]).norm(dim=1)
    pixels = room.scales[:, 1] / distance / (math.pi / 32 * 2.0**room.levels)
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
