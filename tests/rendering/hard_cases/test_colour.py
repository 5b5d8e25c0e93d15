"""Hard cases 31, 34 and 35: channels, spherical harmonics, and colours that end at 0."""

import dataclasses
import math

import pytest
import torch

from pansplat.gaussians.harmonics import harmonics_basis

_BASE = 0.28209479177387814


def _coloured(scene, colours: torch.Tensor):
    return dataclasses.replace(scene, harmonics=((colours - 0.5) / _BASE)[:, None])


@pytest.mark.hard_case(31)
@pytest.mark.parametrize("channels", [1, 3, 32])
def test_a_picture_is_linear_in_its_colours(channels, draw, make_scene, pose, leaves):
    draw.spare(channels == 32)
    scene = make_scene(10, scale=0.3, degree=0)
    generator = torch.Generator().manual_seed(0)
    first, second = torch.rand(2, 10, channels, generator=generator, dtype=torch.float64)

    def picture(colours):
        got = draw(_coloured(scene, colours), pose, background=(0.0,) * channels)
        assert got.color.shape == (channels, *draw.size)
        return got

    mixed = picture(0.3 * first + 1.7 * second)
    expected = 0.3 * picture(first).color + 1.7 * picture(second).color
    assert float(mixed.alpha.mean()) > 0.03
    assert (mixed.color - expected).abs().max() < 10 * draw.image
    # Each channel by itself is what it is among the others, and so are its gradients.
    alone = draw(_coloured(scene, first[:, :1]), pose, background=(0.0,)).color
    assert torch.allclose(alone[0], picture(first).color[0], rtol=0, atol=draw.image)
    together = leaves(_coloured(scene, first).to(dtype=draw.dtype))
    draw(together, pose).color[0].sum().backward()
    single = leaves(_coloured(scene, first[:, :1]).to(dtype=draw.dtype))
    draw(single, pose).color.sum().backward()
    assert not together.harmonics.grad[:, :, 1:].any()
    for name in ("means", "opacities"):
        found, expected = getattr(together, name).grad, getattr(single, name).grad
        assert float((found - expected).norm()) <= draw.gradient * float(expected.norm()), name


@pytest.mark.hard_case(31)
def test_distance_as_a_channel_is_the_depth(draw, make_scene, pose):
    scene = make_scene(10, scale=0.3, degree=0)
    distance = (scene.means - pose[:3, 3]).norm(dim=1)[:, None]
    got = draw(_coloured(scene, distance), pose)
    assert (got.color[0] - got.depth * got.alpha).abs().max() < 10 * draw.image
    assert float(got.depth.max()) > 1


@pytest.mark.hard_case(34)
def test_every_harmonic_up_to_degree_4_colours_as_it_should(draw, balls):
    """The original never evaluates coefficients 16 to 24, and takes the wrong axis for coefficient 14."""
    ahead = torch.tensor((0.48, -0.36, 0.8), dtype=torch.float64)
    expected = harmonics_basis(ahead, 4)
    scene = balls(2 * ahead, 1.0, 1.0)
    harmonics = torch.zeros(1, 25, 25, dtype=torch.float64)
    harmonics[0] = 0.3 * torch.eye(25, dtype=torch.float64)  # channel k holds harmonic k alone
    scene = dataclasses.replace(scene, harmonics=harmonics)
    if draw.interpreted:
        scene = dataclasses.replace(scene, harmonics=harmonics[:, :, 12:18])
        expected = expected[12:18]
    got = draw(scene, background=(0.0,) * len(expected))
    row, column = divmod(int(got.alpha.argmax()), draw.size[1])
    colours = got.color[:, row, column] / got.alpha[row, column]
    assert (colours - (0.5 + 0.3 * expected)).abs().max() < 20 * draw.image


@pytest.mark.hard_case(34)
@pytest.mark.parametrize("degree", range(5))
def test_gradients_of_harmonics_and_of_their_direction_are_exact(degree, draw, make_scene, pose, equals_dense):
    draw.spare(degree not in (0, 4))
    equals_dense(draw, make_scene(5, scale=0.4, degree=degree, seed=7), pose, looser=2)


@pytest.mark.hard_case(35)
def test_a_colour_at_0_is_black_and_has_a_slope_above_only(draw, balls, leaves):
    scene = balls((0, 0, 2.0), 1.0)
    at, step = -0.5 / _BASE, 0.125
    harmonics = torch.tensor([[[at - step, at, at + step]]], dtype=draw.dtype)
    harmonics[0, 0, 1] = -0.5 / torch.tensor(_BASE, dtype=draw.dtype)
    scene = leaves(dataclasses.replace(scene.to(dtype=draw.dtype), harmonics=harmonics))
    got = draw(scene)
    got.color.sum().backward()
    color, mass = got.color.detach(), float(got.alpha.detach().sum())
    assert not color[0].any() and float(color[1].max()) < 1e-6
    assert float(color[2].sum()) == pytest.approx(_BASE * step * mass, rel=1e-4)
    slopes = scene.harmonics.grad[0, 0]
    assert float(slopes[0]) == 0 and float(slopes[2]) == pytest.approx(_BASE * mass, rel=1e-4)
    assert math.isfinite(float(slopes[1]))


@pytest.mark.hard_case(35)
def test_the_slope_of_a_colour_at_exactly_0_is_0(draw, balls, leaves):
    """A colour of exactly 0: the constant harmonic of -1/2 over its own value rounds to nothing but -0.5."""
    base = harmonics_basis(torch.tensor([[0.0, 0.0, 1.0]], dtype=draw.dtype), 0)[0, 0]
    value = torch.tensor(-0.5, dtype=draw.dtype) / base
    candidates = [value, torch.nextafter(value, value - 1), torch.nextafter(value, value + 1)]
    exact = [v for v in candidates if float(base * v + 0.5) == 0]
    assert exact
    scene = balls((0, 0, 2.0), 1.0).to(dtype=draw.dtype)
    scene = leaves(dataclasses.replace(scene, harmonics=exact[0].expand(1, 1, 3).clone()))
    got = draw(scene)
    got.color.sum().backward()
    assert not got.color.any() and not scene.harmonics.grad.any()
