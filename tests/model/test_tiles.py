"""Tiles and windows: each point in one tile, each window a piece of the whole resized and continued map."""

import pytest
import torch
from torch.nn import functional

from pansplat.geometry.equirect import pad_equirect, sample_equirect
from pansplat.model.layers import resize
from pansplat.model.tiles import (
    Margins,
    Tile,
    Window,
    crop_window,
    lattice_uv,
    sample_panorama,
    sample_window,
    tile_grid,
)


def _random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("lattice", ["fibonacci", "pixel"])
@pytest.mark.parametrize("grid", [1, 2, 4])
def test_each_point_belongs_to_exactly_one_tile(lattice, grid):
    for exact in (True, False):
        uv = lattice_uv(lattice, 64, exact=exact)
        held = torch.stack([tile.contains(uv) for tile in tile_grid(grid)])
        assert bool((held.sum(dim=0) == 1).all())
        assert int(held.sum(dim=1).min()) > 0


def test_points_lie_inside_their_tiles_window():
    uv = lattice_uv("fibonacci", 64)
    for tile in tile_grid(4):
        window = tile.window(64)
        pixel = uv[tile.contains(uv)] * torch.tensor((128, 64))
        assert bool((pixel[:, 0] >= window.left).all() and (pixel[:, 0] <= window.left + window.width).all())
        assert bool((pixel[:, 1] >= window.top).all() and (pixel[:, 1] <= window.top + window.height).all())


@pytest.mark.parametrize("height", [8, 16, 32, 64, 128])
def test_a_window_of_the_sphere_is_cut_from_the_resized_and_padded_map(height):
    source = _random(3, 32, 64)
    whole = pad_equirect(resize(source[None], (height, 2 * height), "fixed")[0], 7)
    for tile in tile_grid(2):
        window = tile.window(height).expand(7)
        expected = whole[:, window.top + 7 :, window.left + 7 :][:, : window.height, : window.width]
        assert torch.allclose(crop_window(source, height, window, "fixed"), expected, atol=1e-14)


@pytest.mark.parametrize("height", [8, 16, 32, 64, 128])
def test_the_originals_window_wraps_columns_and_has_zero_rows(height):
    source = _random(3, 32, 64)
    resized = functional.interpolate(source[None], (height, 2 * height), mode="bilinear", align_corners=False)[0]
    whole = functional.pad(torch.cat((resized[..., -3:], resized, resized[..., :3]), dim=-1), (0, 0, 3, 3))
    for tile in tile_grid(2):
        window = tile.window(height).expand(3)
        expected = whole[:, window.top + 3 :, window.left + 3 :][:, : window.height, : window.width]
        assert torch.allclose(crop_window(source, height, window, "official"), expected, atol=1e-14)


def test_samples_at_pixel_centres_are_the_pixels():
    source = _random(5, 8, 16)
    samples = sample_window(source, Window(0, 0, 8, 16), 8, lattice_uv("pixel", 8))
    assert torch.allclose(samples, source.flatten(1).T, atol=1e-14)


def test_samples_of_a_whole_map_know_the_sphere_or_its_border():
    source, uv = _random(5, 8, 16), lattice_uv("fibonacci", 32)
    assert torch.allclose(sample_panorama(source, uv, "fixed"), sample_equirect(source, uv).T, atol=1e-14)
    grid = (2 * uv - 1)[None, None]
    border = functional.grid_sample(source[None], grid, padding_mode="border", align_corners=False)[0, :, 0].T
    assert torch.allclose(sample_panorama(source, uv, "official"), border, atol=1e-14)


def test_cut_and_sample_are_differentiable():
    uv = lattice_uv("fibonacci", 8)[:20]
    window = Window(-2, -3, 20, 38)

    def read(source: torch.Tensor) -> torch.Tensor:
        return sample_window(crop_window(source, 16, window, "fixed"), window, 16, uv)

    assert torch.autograd.gradcheck(read, (_random(2, 8, 16).requires_grad_(),))


def test_margins_let_the_next_level_be_read_with_the_same_margin():
    margins = Margins.of(3, "fixed", chained=True)
    assert margins.input - margins.output == 3  # a pixel a convolution
    # The farthest pixel the next CNN reads lies between these two of ours, which must be known.
    farthest = (-margins.input + 0.5) / 2 - 0.5
    assert -margins.output <= farthest - 0.25
    assert (-(margins.input - 1) + 0.5) / 2 - 0.5 - 0.25 <= -margins.output + 1  # one less would not be spare
    assert Margins.of(3, "official", chained=True) == Margins(3, 3)


def test_a_grid_runs_row_by_row():
    assert tile_grid(2) == [Tile(0, 0, 2), Tile(0, 1, 2), Tile(1, 0, 2), Tile(1, 1, 2)]
    assert Tile(1, 0, 2).window(8) == Window(4, 0, 4, 8)
    assert Window(4, 0, 4, 8).expand(2) == Window(2, -2, 8, 12)
