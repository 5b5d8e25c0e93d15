"""Hard case 50: both ends of the Fibonacci lattice, and its spacing where float32 fails."""

import math

import pytest
import torch
from scipy.spatial import cKDTree

from pansplat.geometry.equirect import directions_from_uv
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size, official_fibonacci_uv


@pytest.mark.hard_case(50)
@pytest.mark.parametrize("count", [1, 2, 3, 100, lattice_size(4096)])
def test_the_lattice_ends_at_the_poles_without_nan(count):
    directions = fibonacci_directions(count)
    assert directions.shape == (count, 3) and torch.isfinite(directions).all()
    assert torch.allclose(directions.norm(dim=1), torch.ones(count, dtype=directions.dtype), atol=1e-6)
    for end in (0, -1):
        assert abs(float(directions[end, 1])) <= 1
    if count >= 100:
        assert abs(float(directions[0, 1])) > 0.97 and float(directions[0, 1] * directions[-1, 1]) < 0


def _nearest(directions: torch.Tensor, band: slice) -> torch.Tensor:
    """Distances of 4000 lattice points to their nearest neighbours, in pixels of a 4K panorama."""
    points = directions[band].double().numpy()
    some = points[len(points) // 2 - 2000 : len(points) // 2 + 2000]
    distance, _ = cKDTree(points).query(some, k=2)
    return torch.from_numpy(distance[:, 1]) * 4096 / (2 * math.pi)


@pytest.mark.hard_case(50)
def test_neighbours_keep_their_distance_at_4k_where_the_official_lattice_does_not():
    count = lattice_size(4096)
    assert count > 5_000_000
    ours, theirs = fibonacci_directions(count), directions_from_uv(official_fibonacci_uv(count))
    for middle in (count // 3, count // 2, count - 200_000):
        band = slice(middle - 40_000, middle + 40_000)
        nearest = _nearest(ours, band)
        assert float(nearest.min()) > 0.9 and float(nearest.max()) < 1.05
        assert float(_nearest(theirs, band).min()) < 0.6
    assert float(_nearest(ours, slice(0, 4000)).min()) > 0.5  # around the pole
