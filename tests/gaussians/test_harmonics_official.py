"""Harmonics as the original draws them, against its table of basis functions."""

import pytest
import torch

from pansplat.gaussians.harmonics import evaluate
from pansplat.gaussians.harmonics_official import as_the_original_draws
from pansplat.gaussians.harmonics_rotation import rotate_harmonics

_TO_WORLD = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)  # its x, y, z are z, x, y


def _table(directions: torch.Tensor) -> torch.Tensor:
    """The sixteen functions of OFFICIAL.md 10.3 in world axes, coefficient 14 as it is there."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        (
            torch.full_like(x, 0.28209479), -0.48860251 * x, 0.48860251 * y, -0.48860251 * z,
            1.09254843 * z * x, -1.09254843 * x * y, 0.31539157 * (2 * yy - zz - xx), -1.09254843 * z * y,
            0.54627422 * (zz - xx), -0.59004359 * x * (3 * zz - xx), 2.89061144 * z * x * y,
            -0.45704580 * x * (4 * yy - zz - xx), 0.37317633 * y * (2 * yy - 3 * zz - 3 * xx),
            -0.45704580 * z * (4 * yy - zz - xx), 1.44530572 * z * (zz - xx), -0.59004359 * z * (zz - 3 * xx),
        ),
        dim=-1,
    )  # fmt: skip


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16, 25])
def test_colours_are_those_of_the_originals_table(coefficients):
    generator = torch.Generator().manual_seed(0)
    theirs = 0.3 * torch.randn(40, coefficients, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator, dtype=torch.float64), dim=1)
    drawn = min(coefficients, 16)
    expected = (_table(directions)[:, None, :drawn] @ theirs[:, :drawn])[:, 0] + 0.5
    world = rotate_harmonics(theirs, _TO_WORLD)
    got = evaluate(as_the_original_draws(world), directions)
    assert torch.allclose(got, expected.clamp_min(0), rtol=0, atol=1e-7)
    apart = float((evaluate(world, directions) - got).abs().max())
    assert (apart > 0.05) == (coefficients >= 16) and (coefficients >= 16 or apart == 0)


def test_it_is_linear_and_keeps_type():
    harmonics = torch.randn(5, 25, 2, generator=torch.Generator().manual_seed(0), requires_grad=True)
    drawn = as_the_original_draws(harmonics)
    assert drawn.shape == (5, 16, 2) and drawn.dtype == torch.float32
    (gradient,) = torch.autograd.grad(drawn.sum(), harmonics)
    assert torch.isfinite(gradient).all() and float(gradient[:, 16:].abs().max()) == 0
