"""Hard cases 11, 12 and 13: ties, near ties, and order while the camera moves."""

import dataclasses
import math

import pytest
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats

_RED_GREEN = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)


@pytest.mark.hard_case(11)
@pytest.mark.parametrize("order", ["radial", "z"])
@pytest.mark.parametrize("layout", ["equirect", "cubemap"])
def test_coincident_gaussians_are_composited_in_the_order_of_their_index(order, layout, render, balls):
    pair = balls([(0.4, 0.1, 2.0)] * 2, 0.4, colours=_RED_GREEN)
    for scene, front in ((pair, 0), (pair.select(torch.tensor([1, 0])), 1)):
        color = render(scene, layout=layout, order=order).color
        seen = color.sum(dim=0) > 0.3
        assert seen.any() and (color[front] > 1.1 * color[1 - front])[seen].all()


@pytest.mark.hard_case(11)
def test_permuting_other_gaussians_keeps_the_order_of_ties(render, balls):
    """Other Gaussians in the list do not affect the order of coincident ones."""
    generator = torch.Generator().manual_seed(3)
    others = balls(2.5 * torch.nn.functional.normalize(torch.randn(10, 3, generator=generator)), 0.2)
    ties = balls([(0.4, 0.1, 2.0)] * 3, 0.4, colours=torch.rand(3, 3, generator=generator))
    expected = render(Gaussians.cat([ties, others]), order="radial").color
    mixed = Gaussians.cat([others, ties]).select(torch.tensor([4, 10, 2, 3, 11, 1, 0, 5, 6, 7, 12, 8, 9]))
    got = render(mixed, order="radial").color
    assert (got - expected).abs().max() < 10 * render.image


@pytest.mark.hard_case(12)
def test_swapping_nearly_tied_gaussians_changes_an_image_within_its_bound(render, balls):
    still = balls([(0.1, 0.05, 2.0)] * 2, 0.4, (0.7, 0.6), colours=_RED_GREEN)
    middle = render(still)
    first, second = (render(still.select(torch.tensor([i]))).alpha for i in (0, 1))
    bound = (first * second)[None] * (_RED_GREEN[0] - _RED_GREEN[1]).abs()[:, None, None].to(render.dtype)
    for ulp in (-1, 1):
        means = still.means.to(render.dtype).clone()
        means[1] = torch.nextafter(means[1], means[1] + ulp)
        moved = render(dataclasses.replace(still.to(dtype=render.dtype), means=means))
        assert ((moved.color - middle.color).abs() <= bound + 10 * render.image).all()
        assert (moved.alpha - middle.alpha).abs().max() < 10 * render.image


@pytest.mark.hard_case(13)
def test_radial_order_does_not_depend_on_the_cameras_rotation(render, balls):
    """Distances are computed before any rotation, so even adjacent float32 numbers keep their order."""
    base = torch.tensor((0.3, 0.2, 2.0), dtype=torch.float32)
    other = base.clone()
    other[2] = torch.nextafter(base[2], base[2] + 1)
    scene = balls(torch.stack((other, base)), 0.5, 0.9, colours=_RED_GREEN)
    for turn in range(0, 360, 24):
        angle = math.radians(turn) / 2
        quat = torch.tensor((math.cos(angle), 0.3 * math.sin(angle), math.sin(angle), 0.1 * math.sin(angle)))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotations_from_quats(torch.nn.functional.normalize(quat.double(), dim=0))
        color = render(scene, pose, size=(6, 12)).color
        seen = color.sum(dim=0) > 0.5
        assert seen.any() and (color[1] > color[0])[seen].all(), turn


@pytest.mark.hard_case(13)
def test_a_tiny_rotation_changes_the_order_only_by_depth(render, balls, yaw):
    """Two large Gaussians of nearly equal depth: a rotation swaps their depths, never their distances."""
    scene = balls([(-0.4, 0, 2.0), (0.41, 0, 2.0)], 0.8, 0.9, colours=_RED_GREEN)
    jumps = {}
    for order in ("radial", "z"):
        before, after = (render(scene, yaw(a), layout="pinhole", order=order).color for a in (-1e-4, 1e-4))
        jumps[order] = float((after - before).abs().max())
    assert jumps["radial"] < 1e-3 < 0.2 < jumps["z"]
