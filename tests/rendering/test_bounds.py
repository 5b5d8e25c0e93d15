"""Boxes hold every visible pixel, pinhole boxes are exact; tile lists equal brute force."""

import math

import pytest
import torch

from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import equirect_boxes, pinhole_boxes
from pansplat.rendering.reference import TILE_SIZE, intersect_tiles, tile_grid


def _cones(count: int, seed: int, size: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Directions (many at poles, seam and face edges), covariances and levels."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    special = torch.tensor([[0, 1, 0], [0, -1, 0], [0, 0, -1], [1, 0, 1], [1, 1, 1]], dtype=torch.float64)
    jitter = 0.1 * torch.randn(count // 2, 3, generator=generator, dtype=torch.float64)
    direction[: count // 2] = special[torch.arange(count // 2) % 5] + jitter
    direction[:5] = special
    direction = torch.nn.functional.normalize(direction, dim=1)
    axes = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    scales = size * torch.exp(torch.randn(count, 3, generator=generator, dtype=torch.float64))
    axes = axes * scales[:, None, :]
    level = 1 + 10 * torch.rand(count, generator=generator, dtype=torch.float64)
    return direction, axes @ axes.transpose(1, 2) + 1e-6 * torch.eye(3, dtype=torch.float64), level


def _seen(direction, covariance, level, rays):
    """Which rays reach alpha's cut, by the exact response."""
    adjugate = torch.linalg.det(covariance)[:, None, None] * torch.linalg.inv(covariance)
    across = torch.linalg.cross(rays[None].expand(len(direction), -1, 3), direction[:, None].expand(-1, len(rays), 3))
    q = torch.einsum("npi,nij,npj->np", across, covariance, across)
    q = q / torch.einsum("pi,nij,pj->np", rays, adjugate, rays)
    return (q <= level[:, None]) & (torch.einsum("pi,nij,nj->np", rays, adjugate, direction) > 0)


@pytest.mark.parametrize("size", [0.003, 0.03, 0.3])
def test_panorama_boxes_hold_every_visible_pixel_and_little_more(size):
    height, width = 48, 96
    direction, covariance, level = _cones(200, 1, size)
    (picture,) = image_planes(
        "equirect", (height, width), vertical_fov_degrees=90, face_size=None, device=torch.device("cpu")
    )
    seen = _seen(direction, covariance, level, picture.directions().reshape(-1, 3)).reshape(-1, height, width)
    left, right, top, bottom = (
        t[:, None] for t in equirect_boxes(direction, covariance, level, (height, width)).unbind(1)
    )
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    across = sum(((x + k * width >= left - 1e-6) & (x + k * width <= right + 1e-6)).long() for k in (-1, 0, 1)) > 0
    inside = ((y >= top - 1e-6) & (y <= bottom + 1e-6))[:, :, None] & across[:, None, :]
    assert not (seen & ~inside).any()
    if size < 0.1:  # ellipses in boxes cover about pi/4, less where they lie aslant or near a pole
        assert float(seen.sum() / inside.sum()) > 0.2


@pytest.mark.parametrize("size", [0.01, 0.05, 0.5])
def test_pinhole_boxes_hold_every_visible_pixel_and_touch_it(size):
    (picture,) = image_planes("pinhole", (60, 80), vertical_fov_degrees=90, face_size=None, device=torch.device("cpu"))
    direction, covariance, level = _cones(200, 2, size)
    seen = _seen(direction, covariance, level, picture.directions().reshape(-1, 3)).reshape(-1, 60, 80)
    boxes = pinhole_boxes(direction, covariance, level, (60, 80), picture.focal)
    for axis, extent, (low, high) in ((1, 80, boxes[:, :2].unbind(1)), (2, 60, boxes[:, 2:].unbind(1))):
        shadow = seen.any(dim=axis)
        centre = torch.arange(extent) + 0.5
        inside = (centre >= low[:, None] - 1e-6) & (centre <= high[:, None] + 1e-6)
        assert not (shadow & ~inside).any()
        # Cones that are wholly in the picture: a pixel beside their edge is seen.
        whole = (boxes[:, 0] > 2) & (boxes[:, 1] < 78) & (boxes[:, 2] > 2) & (boxes[:, 3] < 58)
        whole &= (boxes[:, 1] - boxes[:, 0] > 12) & (boxes[:, 3] - boxes[:, 2] > 12)
        extra = (inside & ~shadow).sum(dim=1)[whole]
        assert size != 0.05 or (len(extra) >= 5 and float(extra.double().mean()) < 2.5)


@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("size", [(40, 64), (37, 53), (5, 7), (16, 9)])
def test_tile_lists_equal_brute_force_in_bands_of_any_size(wraps, size):
    height, width = size
    generator = torch.Generator().manual_seed(0)
    count = 300
    start = torch.rand(count, 2, generator=generator) * torch.tensor((2.0 * width, 2.0 * height)) - 5
    extent = torch.exp(1.2 * torch.randn(count, 2, generator=generator)) * 4 - 1
    boxes = torch.stack(
        (
            start[:, 0] - width / 2,
            start[:, 0] - width / 2 + extent[:, 0],
            start[:, 1],
            start[:, 1] + extent[:, 1],
        ),
        dim=1,
    ).double()
    boxes[:4] = torch.tensor([[-1e9, 1e9, 3, 5], [-1e9, 1e9, -1e9, 1e9], [1, -1, 1, -1], [-3, 2, 0, 4]])
    order = torch.randperm(count, generator=generator)
    rows, columns = tile_grid(height, width)
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    shifts = (-1, 0, 1) if wraps else (0,)
    for limit in (1 << 20, 100):
        found = {}
        for lists in intersect_tiles(boxes, order, size, wraps=wraps, limit=limit):
            for tile in range(*lists.tiles):
                low, high = lists.starts[tile - lists.tiles[0]], lists.starts[tile - lists.tiles[0] + 1]
                found[tile] = lists.indices[low:high].tolist()
        assert sorted(found) == list(range(rows * columns))
        rank = {int(g): i for i, g in enumerate(order)}
        for tile, entries in found.items():
            assert [rank[g] for g in entries] == sorted({rank[g] for g in entries})
            px = x[(tile % columns) * TILE_SIZE : (tile % columns + 1) * TILE_SIZE]
            py = y[(tile // columns) * TILE_SIZE : (tile // columns + 1) * TILE_SIZE]
            across = torch.stack(
                [((px + k * width >= boxes[:, :1]) & (px + k * width <= boxes[:, 1:2])).any(dim=1) for k in shifts]
            ).any(dim=0)
            down = ((py >= boxes[:, 2:3]) & (py <= boxes[:, 3:4])).any(dim=1)
            needed = set(torch.nonzero(across & down)[:, 0].tolist())
            assert needed <= set(entries)
            # Nothing whose box, widened by the margin and rounded to pixels, stays clear of the tile.
            spare = set(entries) - needed
            near = ((px[0] - 1 <= boxes[:, 1]) & (px[-1] + 1 >= boxes[:, 0])) if not wraps else down | True
            assert all(near[g] for g in spare)


def test_a_picture_is_the_same_in_narrow_bands(make_scene, pose, monkeypatch):
    from pansplat.rendering import rasterize, reference

    scene = make_scene(120, scale=0.3)
    whole = rasterize(scene, pose, size=(40, 80))
    monkeypatch.setattr(reference, "intersect_tiles", lambda *a, **k: intersect_tiles(*a, **k, limit=50))
    assert torch.equal(rasterize(scene, pose, size=(40, 80)).color, whole.color)
    assert math.isfinite(float(whole.color.sum()))
