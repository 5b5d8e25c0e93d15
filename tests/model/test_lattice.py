"""Lattices of a level: even on the sphere or one a pixel, and points that move at most half a pixel."""

import math

import pytest
import torch

from pansplat.geometry.equirect import directions_from_uv
from pansplat.geometry.fibonacci import fibonacci_directions, lattice_size
from pansplat.model.tiles import lattice_uv, move_points


def test_fibonacci_points_are_the_geometrys():
    uv = lattice_uv("fibonacci", 32)
    assert len(uv) == lattice_size(64)
    assert torch.allclose(directions_from_uv(uv), fibonacci_directions(len(uv)), atol=1e-14)


def test_pixel_points_are_the_pixels_centres_row_by_row():
    uv = lattice_uv("pixel", 4)
    assert uv.shape == (32, 2)
    assert uv[0].tolist() == [0.5 / 8, 0.5 / 4] and uv[9].tolist() == [1.5 / 8, 1.5 / 4]


def test_the_originals_points_are_near_ours():
    exact, official = (lattice_uv("fibonacci", 64, exact=exact) for exact in (True, False))
    difference = (exact - official)[1:-1].abs() * torch.tensor((128, 64))
    assert 0 < float(difference[:, 1].max()) < 1e-3 and float(difference[:, 0].median()) < 0.05


@pytest.mark.parametrize("lattice", ["fibonacci", "pixel"])
def test_points_without_offset_stay(lattice):
    uv = lattice_uv(lattice, 16)
    assert torch.equal(move_points(uv, torch.zeros_like(uv), lattice, 16), uv)


def test_points_move_half_a_pixel_of_their_latitude_at_most():
    uv = lattice_uv("fibonacci", 32)
    moved = move_points(uv, torch.full_like(uv, 50.0), "fibonacci", 32) - uv
    assert torch.allclose(moved[:, 1], torch.full_like(moved[:, 1], 0.5 / 32))
    arc = moved[:, 0] * 64 * torch.sin(uv[:, 1] * math.pi)
    inner = (uv[:, 1] - 0.5).abs() < 0.49
    assert torch.allclose(arc[inner], torch.full_like(arc[inner], 0.5))
    assert float(moved[:, 0].max()) <= 0.5 / 64 / 0.01 + 1e-12


def test_a_kept_lattice_serves_gradients_too():
    lattice_uv.cache_clear()
    with torch.inference_mode():
        lattice_uv("fibonacci", 8)
    offsets = torch.zeros(lattice_size(16), 2, dtype=torch.float64, requires_grad=True)
    (move_points(lattice_uv("fibonacci", 8), offsets, "fibonacci", 8) ** 2).sum().backward()
    assert offsets.grad is not None and bool(torch.isfinite(offsets.grad).all())
