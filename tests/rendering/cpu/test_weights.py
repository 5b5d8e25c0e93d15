"""Stored blending weights: products with colours and with images, against the float64 reference."""

from __future__ import annotations

import pytest
import torch
from dense_renderer import POSE, make_scene
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.cpu import weights as weights_module
from pansplat.rendering.cpu.weights import StoredWeights
from pansplat.rendering.weights import compute_blending_weights

SIZE = (40, 80)


@pytest.fixture
def scene() -> Gaussians:
    return make_scene(600, scale=0.15, degree=0, seed=1).to(dtype=torch.float32)


@pytest.fixture
def values() -> Tensor:
    return torch.rand(600, 3, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def image() -> Tensor:
    return torch.randn(3, *SIZE, generator=torch.Generator().manual_seed(2))


@pytest.mark.parametrize("channels", [1, 3])
def test_products_equal_the_reference(channels, scene, values, image):
    stored = StoredWeights(scene, POSE, SIZE)
    expected = compute_blending_weights(scene.to(dtype=torch.float64), POSE, SIZE)
    values, image = values[:, :channels], image[:channels]
    blended = expected.blend(values.double())
    assert blended.max() > 0.5
    torch.testing.assert_close(stored.blend(values).double(), blended, rtol=0, atol=2e-6)
    totals = expected.accumulate(image.double())
    error = (stored.accumulate(image).double() - totals).norm() / totals.norm()
    assert error < 1e-5


def test_bands_that_are_not_stored_give_the_same_products(scene, values, image, monkeypatch):
    whole = StoredWeights(scene, POSE, SIZE)
    expected = whole.blend(values), whole.accumulate(image)
    size = weights_module.MAX_STORED_PAIRS - whole._free
    for stored_pairs, num_stored in ((0, 0), (int(0.7 * size), 1)):
        monkeypatch.setattr(weights_module, "MAX_BAND_INTERSECTIONS", 20)
        monkeypatch.setattr(weights_module, "MAX_STORED_PAIRS", stored_pairs)
        banded = StoredWeights(scene, POSE, SIZE)
        for _ in range(2):
            assert torch.equal(banded.blend(values), expected[0])
            torch.testing.assert_close(banded.accumulate(image), expected[1], rtol=1e-4, atol=1e-4)
        assert (len(banded._stored), len(banded._bands)) == (num_stored, 2)


def test_the_number_of_threads_changes_no_bit(scene, values, image, run_with_threads):
    def run():
        stored = StoredWeights(scene, POSE, SIZE)
        return stored.blend(values), stored.accumulate(image)

    first, *others = run_with_threads(run)
    assert all(torch.equal(*pair) for other in others for pair in zip(other, first, strict=True))


def test_no_gaussians_give_a_black_image(scene, image):
    stored = StoredWeights(scene.select(torch.zeros(600, dtype=torch.bool)), POSE, SIZE)
    assert not stored.blend(torch.empty(0, 3)).any()
    assert stored.accumulate(image).shape == (0, 3)
