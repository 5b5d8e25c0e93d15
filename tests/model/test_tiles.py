"""Lattice points, tiles and windows of maps."""

import math

import pytest
import torch
from synthetic_scenes import draw_noise
from torch.nn import functional

from pansplat.geometry.fibonacci import lattice_size
from pansplat.model.tiles import crop_window, make_lattice_uv, make_tiles, move_points


@pytest.mark.parametrize("height", [8, 32, 128])
def test_an_official_window_wraps_columns_and_has_zero_rows(height):
    source = draw_noise(3, 32, 64)
    resized = functional.interpolate(source[None], (height, 2 * height), mode="bilinear", align_corners=False)[0]
    whole = functional.pad(torch.cat((resized[..., -3:], resized, resized[..., :3]), dim=-1), (0, 0, 3, 3))
    for tile in make_tiles(2):
        window = tile.window(height).expand(3)
        expected = whole[:, window.top + 3 :, window.left + 3 :][:, : window.height, : window.width]
        assert torch.allclose(crop_window(source, height, window, "official"), expected, atol=1e-14)


def test_points_move_at_most_half_a_pixel_of_their_latitude():
    uv = make_lattice_uv(32)
    moved = move_points(uv, torch.full_like(uv, 50.0), 32) - uv
    assert torch.allclose(moved[:, 1], torch.full_like(moved[:, 1], 0.5 / 32))
    arc = moved[:, 0] * 64 * torch.sin(uv[:, 1] * math.pi)
    inner = (uv[:, 1] - 0.5).abs() < 0.49
    assert torch.allclose(arc[inner], torch.full_like(arc[inner], 0.5))
    assert float(moved[:, 0].max()) <= 0.5 / 64 / 0.01 + 1e-12


def test_a_lattice_cached_in_inference_mode_serves_gradients():
    make_lattice_uv.cache_clear()
    with torch.inference_mode():
        make_lattice_uv(8)
    offsets = torch.zeros(lattice_size(16), 2, dtype=torch.float64, requires_grad=True)
    (move_points(make_lattice_uv(8), offsets, 8) ** 2).sum().backward()
    assert offsets.grad is not None and bool(torch.isfinite(offsets.grad).all())
