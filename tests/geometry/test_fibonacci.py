"""Fibonacci lattices: the paper's counts, exact poles, uniform spacing at any size, and the official rounding."""

import math

import pytest
import torch

from pansplat.geometry.equirect import uv_from_directions
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size, official_fibonacci_uv


def test_lattice_sizes_equal_those_of_the_paper():
    sizes = {64: 1303, 128: 5215, 256: 20860, 512: 83443, 1024: 333772, 2048: 1335088, 4096: 5340353}
    assert {width: lattice_size(width) for width in sizes} == sizes
    assert 2 * sum(lattice_size(1024 >> level) for level in range(4)) == 886580


@pytest.mark.parametrize("count", [1, 2, 3, 1303, 83443])
def test_points_are_unit_vectors_from_pole_to_pole(count):
    points = fibonacci_directions(count)
    assert torch.allclose(points.norm(dim=1), torch.ones(count, dtype=torch.float64), atol=1e-14)
    assert points[0].tolist() == [0, 1, 0]
    if count > 1:
        assert points[-1].tolist() == [0, -1, 0]


def test_an_empty_lattice_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        fibonacci_directions(0)


@pytest.mark.parametrize(("width", "error"), [(16, 1e-5), (128, 2e-3), (512, 1e-2)])
def test_lattices_equal_the_official_ones_up_to_their_rounding(golden, width, error):
    lonlat = golden("units")[f"fibonacci.{width}"].double()
    points = fibonacci_directions(len(lonlat))
    lon, lat = lonlat[1:-1].unbind(-1)
    expected = torch.stack((lat.cos() * lon.sin(), lat.sin(), lat.cos() * lon.cos()), dim=-1)
    # The official float32 product loses accuracy as the index grows (trap T1): 0.25 pixel on average at 512.
    assert float((points[1:-1] - expected).norm(dim=1).median()) < error
    official = (official_fibonacci_uv(len(lonlat)) - 0.5) * torch.tensor((2 * math.pi, math.pi), dtype=torch.float64)
    difference = official - lonlat
    difference[:, 0] -= (difference[:, 0] / (2 * math.pi)).round() * 2 * math.pi
    assert float(difference.abs().max()) < 1e-6


@pytest.mark.slow
def test_the_official_rounding_errors_grow_with_the_count():
    for width, pixels in ((128, 0.1), (4096, 10.0)):
        count = lattice_size(width)
        uv, exact = official_fibonacci_uv(count), uv_from_directions(fibonacci_directions(count))
        error = (uv - exact)[1:-1, 0].abs()
        error = torch.minimum(error, 1 - error).mean() * width
        assert (float(error) < pixels) == (width == 128)
    with pytest.raises(ValueError, match="at least 2"):
        official_fibonacci_uv(1)
