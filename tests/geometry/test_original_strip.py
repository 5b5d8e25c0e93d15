"""The original's way between panorama and faces: its own bits, and the numbers of the way that is used elsewhere."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pansplat.geometry.cubemap import equirect_from_strip, strip_from_equirect, strip_lookup
from pansplat.geometry.original_strip import original_lookup, original_panorama, original_strip


def _smooth(*shape: int) -> Tensor:
    """Noise without steps, so that positions a little off show little."""
    noise = torch.rand(shape, generator=torch.Generator().manual_seed(3))
    return torch.nn.functional.avg_pool2d(noise, 5, stride=1, padding=2)


def test_the_strip_is_that_of_exact_positions_but_for_their_rounding():
    image = _smooth(3, 64, 128)
    assert torch.allclose(original_strip(image, 32), strip_from_equirect(image, 32), atol=1e-5)


def test_a_constant_panorama_has_constant_faces():
    image = torch.full((2, 16, 32), 0.3)
    assert torch.equal(original_strip(image, 8), torch.full((2, 8, 48), 0.3))


@pytest.mark.parametrize("height", [16, 64])
def test_the_lookup_is_the_exact_one_but_for_its_rounding(height: int):
    found, expected = original_lookup(height), strip_lookup(height)
    assert torch.allclose(found[..., :2].double(), expected[..., :2], atol=2e-6)
    assert torch.allclose(found[..., 2].double(), expected[..., 2] / 2.5 - 1, atol=1e-7)


def test_the_panorama_is_that_of_single_faces_but_for_the_rounding():
    faces = _smooth(6, 3, 16, 16)[None]
    strip = faces.permute(0, 2, 3, 1, 4).flatten(-2)
    found = original_panorama(faces, original_lookup(32))
    assert torch.allclose(found, equirect_from_strip(strip, strip_lookup(32)), atol=1e-5)


@pytest.mark.shared
def test_the_strips_bits_are_the_originals(golden: Callable[[str], dict[str, Tensor]]):
    units = golden("units")
    found = original_strip(units["e2c.in"].movedim(-1, 0).contiguous(), units["e2c.out"].shape[0])
    assert float((found == units["e2c.out"].movedim(-1, 0)).float().mean()) > 0.999


@pytest.mark.shared
def test_the_lookup_is_the_originals_bit_for_bit(recipe_weights: dict[str, Tensor]):
    for scale in range(1, 6):
        stored = recipe_weights[f"mono_depth.c2e.{scale}.sample_grid"][0, 0]
        assert torch.equal(original_lookup(512 >> scale), stored)
