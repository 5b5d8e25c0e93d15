"""The torch reference against closed forms; its tile intersections."""

import functools
import math

import pytest
import torch
from dense_renderer import POSE, make_scene, make_spheres

from pansplat.geometry.equirect import pixel_directions
from pansplat.rendering import rasterize as _rasterize
from pansplat.rendering import reference
from pansplat.rendering.reference import intersect_tiles, tile_grid

rasterize = functools.partial(_rasterize, backend="torch")  # float32 too

_ORIGIN = torch.eye(4, dtype=torch.float64)


@pytest.mark.parametrize("mean", [(1.0, -0.7, 1.3), (0, -2.0, 0), (-0.1, 0.2, -3.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ball_has_its_closed_form(mean, dtype):
    height, sigma, opacity = 64, 0.1, 0.8
    got = rasterize(make_spheres(mean, sigma, opacity).to(dtype=dtype), _ORIGIN, size=(height, 2 * height))
    mean = torch.tensor(mean, dtype=torch.float64)
    radius = mean.norm()
    cosine = pixel_directions(height, 2 * height, dtype=torch.float64) @ (mean / radius)
    sine2 = 1 - cosine**2
    own, filtered = (sigma / radius) ** 2, (sigma / radius) ** 2 + 0.1 * (math.pi / height) ** 2
    q = sine2 / (filtered * cosine**2 + own * sine2)
    alpha = (opacity * own / filtered) * torch.exp(-q / 2)
    alpha = torch.where((cosine > 0) & (alpha >= 1 / 255), alpha, 0)
    tolerance = 2e-6 if dtype == torch.float32 else 1e-13
    assert got.alpha.dtype == got.color.dtype == got.depth.dtype == dtype
    assert (got.alpha - alpha).abs().max() < tolerance
    colour = torch.tensor((0.9, 0.4, 0.2), dtype=torch.float64)[:, None, None]
    assert (got.color - alpha * colour).abs().max() < tolerance
    assert torch.allclose(got.depth.double(), torch.where(alpha > 0, radius, 0.0), rtol=1e-6)
    assert 0 < float((alpha > 0).double().mean()) < 0.1


def test_an_image_is_the_same_in_narrow_bands(monkeypatch):
    scene = make_scene(120, scale=0.3)
    whole = rasterize(scene, POSE, size=(40, 80))
    monkeypatch.setattr(reference, "intersect_tiles", functools.partial(intersect_tiles, limit=50))
    assert torch.equal(rasterize(scene, POSE, size=(40, 80)).color, whole.color)
    assert math.isfinite(float(whole.color.sum()))


def test_intersections_are_counted_in_64_bits_and_listed_in_bands():
    """20,000 Gaussians over all of an 8K panorama have 10^10 intersections."""
    size, count, limit = (4096, 8192), 20_000, 1 << 20
    rows, columns = tile_grid(*size)
    assert count * rows * columns > 2**31
    everywhere = torch.tensor([[-1e9, 1e9, -1e9, 1e9]], dtype=torch.float64).expand(count, 4)
    # A row of tiles has 20 million intersections, so the first band of fewer Gaussians is enough.
    narrow = next(intersect_tiles(everywhere[:100], torch.arange(100), size, wraps=True, limit=limit))
    assert narrow.starts.dtype == torch.int64
    assert narrow.tiles == (0, columns * (limit // (100 * columns)))
    assert len(narrow.indices) <= limit and int(narrow.starts[-1]) == len(narrow.indices)
    assert torch.equal(narrow.indices[:100], torch.arange(100))


@pytest.mark.parametrize("value", [1e9, 1e18, 1e300, float("inf")])
@pytest.mark.parametrize("wraps", [False, True])
def test_boxes_of_any_extent_are_clamped_before_the_cast_to_integers(value, wraps):
    boxes = torch.tensor(
        [[-value, value, -value, value], [value, value, 0, 1], [-value, -value, 0, 1], [3, 5, -value, 9]],
        dtype=torch.float64,
    )
    if wraps:  # boxes of a panorama that start beyond it do not occur
        boxes = boxes[[0, 3]]
    found = list(intersect_tiles(boxes, torch.arange(len(boxes)), (16, 32), wraps=wraps))
    assert len(found) == 1
    per_tile = found[0].starts.diff()
    assert int(per_tile.sum()) == len(found[0].indices)
    assert (torch.bincount(found[0].indices, minlength=len(boxes))[[0, -1]] == torch.tensor([8, 2])).all()
