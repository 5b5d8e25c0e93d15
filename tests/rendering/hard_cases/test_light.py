"""Hard cases 17 to 20 and 30: limits of the opacity, saturation, and weights whose sum is one."""

import dataclasses
import math

import pytest
import torch

from pansplat.constants import ALPHA_CUT

_PINHOLE = {"layout": "pinhole", "lowpass": "3dgs"}


@pytest.mark.hard_case(17)
@pytest.mark.parametrize(
    ("opacity", "expected", "gradient"),
    [
        (0.0, 0.0, 0.0),
        (-0.5, 0.0, 0.0),
        (-1e30, 0.0, 0.0),
        (ALPHA_CUT * (1 - 1e-4), 0.0, 0.0),
        (ALPHA_CUT * (1 + 1e-4), ALPHA_CUT, 1.0),
        (0.5, 0.5, 1.0),
        (1.0, 0.99, 0.0),
        (5.0, 0.99, 0.0),
        (1e29, 0.99, 0.0),
    ],
)
def test_opacity_is_cut_and_clamped_and_has_no_gradient_there(opacity, expected, gradient, render, balls, leaves):
    scene = leaves(balls((0, 0, 2.0), 1.9, opacity).to(dtype=render.dtype))
    got = render(scene, size=(5, 5), **_PINHOLE)
    assert float(got.alpha[2, 2].detach()) == pytest.approx(expected, abs=1e-6)
    got.alpha[2, 2].backward()
    assert float(scene.opacities.grad) == pytest.approx(gradient, abs=1e-5)
    assert torch.isfinite(got.color).all()
    assert all(torch.isfinite(field.grad).all() for field in (scene.means, scene.scales, scene.quats))


def _stack(balls, count: int, opacity: float, depth: float = 1e-6):
    """Gaussians behind each other on the axis, with random colours."""
    generator = torch.Generator().manual_seed(0)
    far = 2 + depth * torch.arange(count, dtype=torch.float64)
    means = torch.stack((torch.zeros_like(far), torch.zeros_like(far), far), dim=1)
    return balls(means, 0.9, opacity, torch.rand(count, 3, generator=generator, dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.hard_case(18)
def test_a_million_gaussians_in_one_pixel_give_the_weighted_mean_of_the_first(render, balls):
    if render.interpreted:
        pytest.skip("takes minutes; the next test saturates a pixel with fewer")
    scene = _stack(balls, 1_000_000, 0.3)
    got = render(scene, size=(1, 1), layout="pinhole")
    # The angular filter of this large pixel lowers the opacity by a known factor.
    own, wide = (0.9 / 2) ** 2, (0.9 / 2) ** 2 + 0.1 * 4
    opacity = 0.3 * own / wide
    weights = opacity * (1 - opacity) ** torch.arange(400, dtype=torch.float64)
    colours = torch.rand(1_000_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)[:400]
    expected = (weights[:, None] * colours).sum(dim=0)
    assert float(got.alpha) == pytest.approx(1, abs=1e-4)
    assert (got.color[:, 0, 0] - expected).abs().max() < 1e-4


@pytest.mark.torch_float32
@pytest.mark.hard_case(18)
def test_gradients_of_a_saturated_pixel_are_exactly_zero_behind_the_front(render, balls, leaves):
    count = 300 if render.interpreted else 3000
    scene = leaves(_stack(balls, count, 0.95).to(dtype=render.dtype))
    got = render(scene, size=(1, 1), **_PINHOLE)
    got.color.sum().backward()
    assert torch.isfinite(got.color).all()
    size = scene.opacities.grad.abs()
    assert torch.isfinite(size).all() and float(size[0]) > 0.01
    tiny = torch.finfo(render.dtype).tiny
    for field in (scene.means, scene.opacities, scene.harmonics):
        gradient = field.grad.abs()
        assert not gradient[100:].any()
        # Denormal numbers are slow; the last step of a backend may contain a few.
        assert int(((gradient > 0) & (gradient < tiny)).sum()) <= 64
    smallest = 0.05**12
    assert (scene.harmonics.grad.abs().amax(dim=(1, 2))[:10] > smallest).all()


@pytest.mark.torch_float32
@pytest.mark.hard_case(19)
@pytest.mark.parametrize("opacity", [0.3, 0.9, 0.999])
def test_gradients_at_low_transmittance_equal_the_dense_renderers(opacity, render, balls, equals_dense):
    render.skip_interpreted(opacity == 0.9)
    count = 12
    scene = _stack(balls, count, opacity, depth=0.01)
    shift = 0.2 * torch.randn(count, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    scene = dataclasses.replace(scene, means=scene.means + shift * torch.tensor((1.0, 1, 0)))
    equals_dense(render, scene, size=(5, 9), fields=("means", "scales", "opacities", "harmonics"), slack=2, **_PINHOLE)


@pytest.mark.hard_case(20)
def test_only_pixels_within_rounding_of_the_alpha_cut_may_differ(render, make_scene, pose, dense):
    scene = make_scene(40, scale=0.2, degree=0).to(dtype=render.dtype)
    truth = scene.to(dtype=torch.float64)
    color, _, _ = dense(truth, pose, render.size)
    band = torch.zeros(render.size, dtype=torch.bool)
    for i in range(len(scene)):
        _, alpha, _ = dense(truth.select(torch.tensor([i])), pose, render.size)
        band |= (alpha > 0) & (alpha < ALPHA_CUT * (1 + 1e-4))
    off = (render(scene, pose).color - color).abs().amax(dim=0)
    assert float(off[~band].max()) < render.image
    assert float(off.max()) <= ALPHA_CUT * 1.5


@pytest.mark.hard_case(30)
@pytest.mark.parametrize("layout", ["equirect", "cubemap", "pinhole"])
def test_a_white_furnace_has_one_colour(layout, render, make_scene, pose, leaves):
    render.skip_interpreted(layout == "cubemap")
    scene = make_scene(30, scale=0.3, degree=0)
    colour = torch.tensor((0.7, 0.3, 0.5), dtype=torch.float64)
    harmonics = ((colour - 0.5) / 0.28209479177387814).expand(30, 1, 3).clone()
    scene = leaves(dataclasses.replace(scene, harmonics=harmonics).to(dtype=render.dtype))
    background = colour.to(render.dtype).clone().requires_grad_()
    got = render(scene, pose, layout=layout, background=background)
    assert float(got.alpha.detach().mean()) > 0.1
    assert (got.color - colour[:, None, None]).abs().max() < (1e-6 if render.dtype == torch.float32 else 1e-13)
    got.color.sum().backward()
    # The weights of the colours and the background have the sum 1 at each pixel.
    weights = scene.harmonics.grad.double().sum(dim=(0, 1)) / 0.28209479177387814 + background.grad.double()
    assert torch.allclose(weights / math.prod(render.size), torch.ones(3, dtype=torch.float64), atol=1e-6)
