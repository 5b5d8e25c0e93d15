"""Features of the panoramas: the original's numbers, and the sphere's symmetries."""

import pytest
import torch

from pansplat.errors import InputError
from pansplat.model.feature_pyramid import FeaturePyramid, FeaturePyramidConfig, TransformerConfig

_SMALL = FeaturePyramidConfig(channels=(8, 8, 8, 16), transformer=TransformerConfig(16, blocks=2, expansion=1))


def _images(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(8), dtype=torch.float64)


def _relative(result, truth):
    return float((result - truth).abs().max() / truth.std())


@pytest.fixture(scope="module")
def small(randomize):
    return randomize(FeaturePyramid(_SMALL, "fixed"))


def test_features_are_the_originals(golden, load_recipe):
    truth = golden("pansplat_64x128_fp32attn")
    pyramid = load_recipe(FeaturePyramid(FeaturePyramidConfig(), "official"), "features")
    refined = []
    pyramid.transformer.register_forward_hook(lambda module, inputs, output: refined.append(output))
    encoded = []
    pyramid.encoder.register_forward_hook(lambda module, inputs, output: encoded.extend(output))
    with torch.inference_mode():
        features = pyramid(truth["in.image"])
    for stage in range(4):
        assert _relative(features[stage], truth[f"backbone.feat.{stage}"]) < 2e-4
    for stage in range(4):
        assert _relative(encoded[3 - stage], truth[f"backbone.cnn.{stage}"][0]) < 2e-4
    for view in range(2):
        assert _relative(refined[0][:, view], truth[f"transformer.{view}"]) < 2e-4


def test_fixed_features_are_not_the_originals(golden, load_recipe):
    truth = golden("pansplat_64x128_fp32attn")
    pyramid = load_recipe(FeaturePyramid(FeaturePyramidConfig(), "fixed"), "features")
    with torch.inference_mode():
        features = pyramid(truth["in.image"])
    assert all(_relative(features[stage], truth[f"backbone.feat.{stage}"]) > 0.1 for stage in range(4))


def test_levels_halve_from_coarse_to_fine(small):
    features = small(_images(2, 3, 3, 32, 64))
    assert [tuple(maps.shape) for maps in features] == [
        (2, 3, 16, 4, 8), (2, 3, 8, 8, 16), (2, 3, 8, 16, 32), (2, 3, 8, 32, 64),
    ]  # fmt: skip


def test_half_a_turn_of_the_panoramas_turns_the_features(small):
    images = _images(1, 2, 3, 32, 64)
    for turned, maps in zip(small(images.roll(32, -1)), small(images), strict=True):
        assert torch.allclose(turned, maps.roll(maps.shape[-1] // 2, -1), atol=1e-11)


def test_each_image_decoded_alone_is_as_all_decoded_together(small):
    coarsest, finer = small.encoder(_images(2, 3, 32, 64))[-1], small.encoder(_images(2, 3, 32, 64))[:-1]
    for alone, together in zip(small.decoder(coarsest, finer), small.decoder._decode(coarsest, finer), strict=True):
        assert torch.allclose(alone, together, atol=1e-13)


def test_gradient_reaches_the_images_and_every_parameter(small):
    small.zero_grad()
    images = _images(1, 2, 3, 32, 64).requires_grad_()
    sum(maps.square().sum() for maps in small(images)).backward()
    assert (images.grad.abs().amax(dim=(1, 2)) > 0).all()
    assert all(parameter.grad.abs().max() > 0 for parameter in small.parameters())


def test_training_mode_normalises_over_the_batch():
    torch.manual_seed(0)
    pyramid = FeaturePyramid(_SMALL, "fixed").train()
    before = pyramid.encoder.levels[0][0].norm.running_mean.clone()
    features = pyramid(_images(1, 2, 3, 32, 64).float())
    assert all(torch.isfinite(maps).all() for maps in features)
    assert not torch.equal(pyramid.encoder.levels[0][0].norm.running_mean, before)


@pytest.mark.parametrize(
    ("compat", "shape", "message"),
    [
        ("fixed", (1, 1, 3, 32, 64), "two or more views, got 1"),
        ("official", (1, 3, 3, 32, 64), "exactly two views, as the original does, got 3"),
        ("fixed", (1, 2, 3, 48, 96), "that 32 divides, got 48x96"),
        ("official", (1, 2, 3, 40, 80), "that 16 divides, got 40x80"),
    ],
)
def test_what_the_pyramid_cannot_take_is_refused(compat, shape, message):
    with pytest.raises(InputError, match=message):
        FeaturePyramid(_SMALL, compat)(torch.zeros(shape))
