"""Lattices: the counts of the paper, exact poles, and even spacing at any size."""

import math
from pathlib import Path

import pytest
import torch

from pansplat.geometry.equirect import uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size, official_fibonacci_uv


def test_lattice_sizes_are_the_papers():
    sizes = {64: 1303, 128: 5215, 256: 20860, 512: 83443, 1024: 333772, 2048: 1335088, 4096: 5340353}
    assert {width: lattice_size(width) for width in sizes} == sizes
    assert 2 * sum(lattice_size(1024 >> level) for level in range(4)) == 886580


@pytest.mark.parametrize("count", [1, 2, 3, 1303, 83443])
def test_points_are_unit_and_end_exactly_at_the_poles(count):
    points = fibonacci_directions(count)
    assert torch.allclose(points.norm(dim=1), torch.ones(count, dtype=torch.float64), atol=1e-14)
    assert points[0].tolist() == [0, 1, 0]
    if count > 1:
        assert points[-1].tolist() == [0, -1, 0]


def test_each_point_is_the_golden_angle_on_from_the_last():
    points = fibonacci_directions(5340353)[-4000:-1000]
    angle = torch.atan2(points[:, 2], points[:, 0])
    step = (angle[1:] - angle[:-1]).remainder(2 * math.pi)
    assert float((step - math.pi * (3 - math.sqrt(5))).abs().max()) < 1e-8


def test_no_two_points_are_close_even_at_4k():
    from scipy.spatial import cKDTree

    count = lattice_size(4096)
    band = fibonacci_directions(count)[count // 3 : count // 3 + 40000].numpy()
    pixel = 2 * math.pi / 4096
    inner = band[15000:25000]
    distance = cKDTree(band).query(inner, k=2)[0][:, 1] / pixel
    assert distance.min() > 0.9 and distance.max() < 1.05


def test_a_lattice_needs_a_point():
    with pytest.raises(ValueError, match="at least 1"):
        fibonacci_directions(0)


@pytest.mark.shared
def test_small_lattices_are_the_originals(shared: Path):
    from safetensors.torch import load_file

    fixtures = load_file(shared / "golden" / "units.safetensors")
    for width in (16, 128, 512):
        lonlat = fixtures[f"fibonacci.{width}"].double()
        points = fibonacci_directions(len(lonlat))
        lon, lat = lonlat[1:-1].unbind(-1)
        expected = torch.stack((lat.cos() * lon.sin(), lat.sin(), lat.cos() * lon.cos()), dim=-1)
        # The original's float32 product loses accuracy as the index grows (trap T1): 0.25 px on average at 512.
        assert float((points[1:-1] - expected).norm(dim=1).median()) < {16: 1e-5, 128: 2e-3, 512: 1e-2}[width]


@pytest.mark.shared
def test_the_originals_lattice_is_reproduced_with_its_rounding(shared: Path):
    from safetensors.torch import load_file

    fixtures = load_file(shared / "golden" / "units.safetensors")
    for width in (16, 128, 512):
        lonlat = fixtures[f"fibonacci.{width}"].double()
        uv = official_fibonacci_uv(len(lonlat))
        difference = (uv - 0.5) * torch.tensor((2 * math.pi, math.pi), dtype=torch.float64) - lonlat
        difference[:, 0] -= (difference[:, 0] / (2 * math.pi)).round() * 2 * math.pi
        assert float(difference.abs().max()) < 1e-6


def test_the_originals_rounding_grows_with_the_count():
    for width, pixels in ((128, 0.1), (4096, 10.0)):
        count = lattice_size(width)
        uv, exact = official_fibonacci_uv(count), uv_from_directions(fibonacci_directions(count))
        error = (uv - exact)[1:-1, 0].abs()
        error = torch.minimum(error, 1 - error).mean() * width
        assert (float(error) < pixels) == (width == 128)
    with pytest.raises(ValueError, match="at least 2"):
        official_fibonacci_uv(1)
