"""The original's sweep: its own bits, and the numbers of the sweep that is used elsewhere."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pansplat.geometry import original_sweep
from pansplat.geometry.correlation import correlate
from pansplat.geometry.original_sweep import correlate_as_the_original, original_grid
from pansplat.geometry.pose import rotations_from_quats
from pansplat.geometry.warp import relative_pose


def _inputs() -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(2)
    reference, other = torch.randn(2, 2, 6, 8, 16, generator=generator, dtype=torch.float64)
    inverse_depth = 0.1 + torch.rand(2, 5, 8, 16, generator=generator, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 2, 1, 1)
    poses[..., :3, :3] = rotations_from_quats(torch.randn(2, 2, 4, generator=generator, dtype=torch.float64))
    poses[..., :3, 3] = 0.3 * torch.randn(2, 2, 3, generator=generator, dtype=torch.float64)
    return reference, other, inverse_depth, *poses


def test_it_is_the_sweep_with_the_originals_sampling():
    reference, other, inverse_depth, first, second = _inputs()
    found = correlate_as_the_original(reference, other, inverse_depth, first, second)
    expected = correlate(reference, other, inverse_depth, relative_pose(first, second), "corners")
    assert torch.allclose(found, expected, atol=1e-11)


def test_groups_of_candidates_change_no_bit(monkeypatch: pytest.MonkeyPatch):
    inputs = [tensor.float() for tensor in _inputs()]
    whole = correlate_as_the_original(*inputs)
    monkeypatch.setattr(original_sweep, "_CHUNK", 1)
    assert torch.equal(correlate_as_the_original(*inputs), whole)


def test_gradients_to_both_features_are_right():
    reference, other, *rest = _inputs()
    leaves = [maps[:, :2, :, :4].contiguous().requires_grad_() for maps in (reference, other)]
    small = [rest[0][:, :2, :, :4].contiguous(), *rest[1:]]
    assert torch.autograd.gradcheck(lambda a, b: correlate_as_the_original(a, b, *small), leaves)


@pytest.mark.shared
def test_the_positions_warp_as_the_originals_do(golden: Callable[[str], dict[str, Tensor]]):
    units = golden("units")
    maps, pose, depth = (units[f"warp.{name}"] for name in ("feature", "pose", "depth"))
    grid = original_grid(1 / depth, pose).flatten(1, 2)
    warped = torch.nn.functional.grid_sample(maps, grid, align_corners=True).unflatten(2, depth.shape[1:3])
    assert torch.allclose(warped, units["warp.out"], atol=1e-5)
