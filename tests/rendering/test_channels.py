"""Any number of channels: linear in their colours, alike one by one and together, with a background of their own."""

import dataclasses

import pytest
import torch

from pansplat.errors import InputError
from pansplat.rendering import rasterize


@pytest.mark.parametrize("channels", [1, 2, 3, 32])
@pytest.mark.parametrize("degree", [0, 2])
def test_channels_drawn_together_are_those_drawn_alone(channels, degree, make_scene, pose):
    scene = make_scene(40, scale=0.25, degree=degree)
    generator = torch.Generator().manual_seed(1)
    shape = (40, (degree + 1) ** 2, channels)
    scene = dataclasses.replace(scene, harmonics=0.4 * torch.randn(shape, generator=generator, dtype=torch.float64))
    background = torch.linspace(0, 1, channels, dtype=torch.float64)
    together = rasterize(scene, pose, size=(12, 24), background=background)
    assert together.color.shape == (channels, 12, 24)
    for c in range(0, channels, 7):
        one = dataclasses.replace(scene, harmonics=scene.harmonics[:, :, c : c + 1])
        alone = rasterize(one, pose, size=(12, 24), background=background[c : c + 1])
        assert torch.allclose(alone.color[0], together.color[c], rtol=0, atol=1e-12)
        assert torch.equal(alone.alpha, together.alpha) and torch.equal(alone.depth, together.depth)


def test_a_default_background_is_black_whatever_the_channels(make_scene, pose):
    scene = make_scene(3)
    for channels in (1, 5):
        one = dataclasses.replace(scene, harmonics=torch.zeros(3, 1, channels, dtype=torch.float64))
        got = rasterize(one, pose, size=(4, 8))
        assert torch.allclose(got.color, 0.5 * got.alpha.expand(channels, 4, 8), rtol=0, atol=1e-12)


def test_gradients_of_five_channels_equal_finite_differences(make_scene, pose):
    scene = make_scene(3, scale=0.6, seed=3, degree=1)
    generator = torch.Generator().manual_seed(2)
    harmonics = 0.2 * torch.randn(3, 4, 5, generator=generator, dtype=torch.float64)
    background = torch.rand(5, generator=generator, dtype=torch.float64)

    def draw(means, harmonics, background):
        changed = dataclasses.replace(scene, means=means, harmonics=harmonics)
        return rasterize(changed, pose, size=(2, 4), background=background).color

    inputs = [t.clone().requires_grad_() for t in (scene.means, harmonics, background)]
    assert torch.autograd.gradcheck(draw, inputs, eps=1e-6, atol=1e-6)


def test_a_background_of_other_channels_is_refused(make_scene, pose):
    with pytest.raises(InputError, match=r"`background` must hold 3 numbers, .* got \(2,\)"):
        rasterize(make_scene(2), pose, size=(4, 8), background=(0.1, 0.2))
