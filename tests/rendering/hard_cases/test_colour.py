"""Hard cases 31, 34 and 35: channels, spherical harmonics, and colours at the clamp at 0."""

import dataclasses
import math

import pytest
import torch

from pansplat.gaussians.harmonics import harmonics_basis

_BASE = 0.28209479177387814


def _coloured(scene, colours: torch.Tensor):
    return dataclasses.replace(scene, harmonics=((colours - 0.5) / _BASE)[:, None])


@pytest.mark.slow
@pytest.mark.hard_case(31)
@pytest.mark.parametrize("channels", [1, 3, 32])
def test_an_image_is_linear_in_its_colours(channels, render, make_scene, pose, leaves):
    render.skip_interpreted(channels == 32)
    scene = make_scene(10, scale=0.3, degree=0)
    generator = torch.Generator().manual_seed(0)
    first, second = torch.rand(2, 10, channels, generator=generator, dtype=torch.float64)

    def image(colours):
        got = render(_coloured(scene, colours), pose, background=(0.0,) * channels)
        assert got.color.shape == (channels, *render.size)
        return got

    mixed = image(0.3 * first + 1.7 * second)
    expected = 0.3 * image(first).color + 1.7 * image(second).color
    assert float(mixed.alpha.mean()) > 0.03
    assert (mixed.color - expected).abs().max() < 10 * render.image
    # A channel rendered alone equals the same channel among others, and so do its gradients.
    alone = render(_coloured(scene, first[:, :1]), pose, background=(0.0,)).color
    assert torch.allclose(alone[0], image(first).color[0], rtol=0, atol=render.image)
    together = leaves(_coloured(scene, first).to(dtype=render.dtype))
    render(together, pose).color[0].sum().backward()
    single = leaves(_coloured(scene, first[:, :1]).to(dtype=render.dtype))
    render(single, pose).color.sum().backward()
    assert not together.harmonics.grad[:, :, 1:].any()
    for name in ("means", "opacities"):
        found, expected = getattr(together, name).grad, getattr(single, name).grad
        assert float((found - expected).norm()) <= render.gradient * float(expected.norm()), name


@pytest.mark.slow
@pytest.mark.hard_case(34)
def test_every_harmonic_up_to_degree_4_has_its_value(render, balls):
    """The official code ignores coefficients 16 to 24, and evaluates coefficient 14 on the wrong axis."""
    ahead = torch.tensor((0.48, -0.36, 0.8), dtype=torch.float64)
    expected = harmonics_basis(ahead, 4)
    scene = balls(2 * ahead, 1.0, 1.0)
    harmonics = torch.zeros(1, 25, 25, dtype=torch.float64)
    harmonics[0] = 0.3 * torch.eye(25, dtype=torch.float64)  # channel k holds harmonic k alone
    scene = dataclasses.replace(scene, harmonics=harmonics)
    if render.interpreted:
        scene = dataclasses.replace(scene, harmonics=harmonics[:, :, 12:18])
        expected = expected[12:18]
    got = render(scene, background=(0.0,) * len(expected))
    row, column = divmod(int(got.alpha.argmax()), render.size[1])
    colours = got.color[:, row, column] / got.alpha[row, column]
    assert (colours - (0.5 + 0.3 * expected)).abs().max() < 20 * render.image


@pytest.mark.slow
@pytest.mark.hard_case(34)
@pytest.mark.parametrize("degree", range(5))
def test_gradients_of_harmonics_and_directions_equal_the_dense_renderers(
    degree, render, make_scene, pose, equals_dense
):
    render.skip_interpreted(degree not in (0, 4))
    equals_dense(render, make_scene(5, scale=0.4, degree=degree, seed=7), pose, slack=2)


@pytest.mark.hard_case(35)
def test_a_colour_is_clamped_at_0_and_has_a_gradient_only_above(render, balls, leaves):
    scene = balls((0, 0, 2.0), 1.0)
    at, step = -0.5 / _BASE, 0.125
    harmonics = torch.tensor([[[at - step, at, at + step]]], dtype=render.dtype)
    harmonics[0, 0, 1] = -0.5 / torch.tensor(_BASE, dtype=render.dtype)
    scene = leaves(dataclasses.replace(scene.to(dtype=render.dtype), harmonics=harmonics))
    got = render(scene)
    got.color.sum().backward()
    color, mass = got.color.detach(), float(got.alpha.detach().sum())
    assert not color[0].any() and float(color[1].max()) < 1e-6
    assert float(color[2].sum()) == pytest.approx(_BASE * step * mass, rel=1e-4)
    gradients = scene.harmonics.grad[0, 0]
    assert float(gradients[0]) == 0 and float(gradients[2]) == pytest.approx(_BASE * mass, rel=1e-4)
    assert math.isfinite(float(gradients[1]))


@pytest.mark.hard_case(35)
def test_the_gradient_of_a_colour_at_exactly_0_is_0(render, balls, leaves):
    """The coefficient is one whose colour is exactly 0 in the backend's type."""
    base = harmonics_basis(torch.tensor([[0.0, 0.0, 1.0]], dtype=render.dtype), 0)[0, 0]
    value = torch.tensor(-0.5, dtype=render.dtype) / base
    candidates = [value, torch.nextafter(value, value - 1), torch.nextafter(value, value + 1)]
    exact = [v for v in candidates if float(base * v + 0.5) == 0]
    assert exact
    scene = balls((0, 0, 2.0), 1.0).to(dtype=render.dtype)
    scene = leaves(dataclasses.replace(scene, harmonics=exact[0].expand(1, 1, 3).clone()))
    got = render(scene)
    got.color.sum().backward()
    assert not got.color.any() and not scene.harmonics.grad.any()
