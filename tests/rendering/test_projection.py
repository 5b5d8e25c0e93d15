"""Bounding boxes contain every visible pixel, and pinhole boxes touch it."""

import pytest
import torch

from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import equirect_boxes, pinhole_boxes


def _cones(count: int, seed: int, size: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Directions (many at poles, seam and face edges), covariances and kappas."""
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
    kappas = 1 + 10 * torch.rand(count, generator=generator, dtype=torch.float64)
    return direction, axes @ axes.transpose(1, 2) + 1e-6 * torch.eye(3, dtype=torch.float64), kappas


def _seen(direction, covariance, kappas, rays):
    """Which rays reach the alpha cut, by the exact response."""
    adjugate = torch.linalg.det(covariance)[:, None, None] * torch.linalg.inv(covariance)
    across = torch.linalg.cross(rays[None].expand(len(direction), -1, 3), direction[:, None].expand(-1, len(rays), 3))
    q = torch.einsum("npi,nij,npj->np", across, covariance, across)
    q = q / torch.einsum("pi,nij,pj->np", rays, adjugate, rays)
    return (q <= kappas[:, None]) & (torch.einsum("pi,nij,nj->np", rays, adjugate, direction) > 0)


@pytest.mark.parametrize("size", [0.003, 0.03, 0.3])
def test_panorama_boxes_contain_every_visible_pixel_and_little_more(size):
    height, width = 48, 96
    cones = _cones(200, 1, size)
    (plane,) = image_planes("equirect", (height, width))
    seen = _seen(*cones, plane.directions().reshape(-1, 3)).reshape(-1, height, width)
    left, right, top, bottom = (t[:, None] for t in equirect_boxes(*cones, (height, width)).unbind(1))
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    across = sum(((x + k * width >= left - 1e-6) & (x + k * width <= right + 1e-6)).long() for k in (-1, 0, 1)) > 0
    inside = ((y >= top - 1e-6) & (y <= bottom + 1e-6))[:, :, None] & across[:, None, :]
    assert not (seen & ~inside).any()
    if size < 0.1:  # ellipses in boxes cover about pi/4, less where they are oblique or near a pole
        assert float(seen.sum() / inside.sum()) > 0.2


@pytest.mark.parametrize("size", [0.01, 0.05, 0.5])
def test_pinhole_boxes_contain_every_visible_pixel_and_touch_it(size):
    (plane,) = image_planes("pinhole", (60, 80))
    cones = _cones(200, 2, size)
    seen = _seen(*cones, plane.directions().reshape(-1, 3)).reshape(-1, 60, 80)
    boxes = pinhole_boxes(*cones, (60, 80), plane.focal)
    for axis, extent, (low, high) in ((1, 80, boxes[:, :2].unbind(1)), (2, 60, boxes[:, 2:].unbind(1))):
        shadow = seen.any(dim=axis)
        centre = torch.arange(extent) + 0.5
        inside = (centre >= low[:, None] - 1e-6) & (centre <= high[:, None] + 1e-6)
        assert not (shadow & ~inside).any()
        if size != 0.05:  # smaller cones are of few pixels, and larger ones leave the image
            continue
        # For cones wholly in the image, a pixel next to the box's edge is seen.
        whole = (boxes[:, 0] > 2) & (boxes[:, 1] < 78) & (boxes[:, 2] > 2) & (boxes[:, 3] < 58)
        whole &= (boxes[:, 1] - boxes[:, 0] > 12) & (boxes[:, 3] - boxes[:, 2] > 12)
        extra = (inside & ~shadow).sum(dim=1)[whole]
        assert len(extra) >= 5 and float(extra.double().mean()) < 2.5
