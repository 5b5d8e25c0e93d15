"""Losses have their closed forms and the gradients of finite differences; masked pixels have no effect."""

import math

import pytest
import torch
from refusals import expect_error
from torch import Tensor

from pansplat.training.losses import (
    PAPER,
    LossWeights,
    Structure,
    auxiliary_loss,
    choose_perceptual,
    depth_loss,
    image_loss,
    ssim_map,
)

NEAR, FAR = 0.5, 10.0


def random_images(height: int = 24, *, seed: int = 0, batch: int = 2) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    images = torch.rand(2, batch, 3, height, 2 * height, generator=random, dtype=torch.float64)
    return images[0], images[1]


def depths(*heights: int, seed: int = 0) -> list[Tensor]:
    random = torch.Generator().manual_seed(seed)
    return [1 + 4 * torch.rand(1, 2, h, 2 * h, generator=random, dtype=torch.float64) for h in heights]


def test_masked_pixels_do_not_affect_the_image_loss() -> None:
    prediction, target = random_images()
    masks = torch.ones(2, 24, 48, dtype=torch.bool)
    masks[:, 16:] = False
    spoilt = prediction.clone()
    spoilt[..., 16:, :] = 9.0
    losses = [image_loss(p, target, Structure(), PAPER, pixel_weights=masks.double()) for p in (prediction, spoilt)]
    assert float(losses[0].total) == pytest.approx(float(losses[1].total), rel=1e-12)
    inside = float((prediction - target)[..., :16, :].square().mean())
    assert float(losses[0].square) == pytest.approx(inside)
    prediction.requires_grad_()
    nothing = image_loss(prediction, target, Structure(), pixel_weights=torch.zeros(2, 24, 48)).total
    nothing.backward()
    assert nothing.item() == 0 and prediction.grad is not None and not prediction.grad.any()


@pytest.mark.parametrize("weighted", [False, True])
def test_the_image_loss_has_the_gradients_of_finite_differences(weighted: bool) -> None:
    prediction, target = random_images(12, batch=1)
    weights = torch.rand(1, 12, 24, generator=torch.Generator().manual_seed(1)).double() if weighted else None

    def total(p: Tensor) -> Tensor:
        return image_loss(p, target, Structure(), pixel_weights=weights).total

    assert torch.autograd.gradcheck(total, prediction.requires_grad_(), fast_mode=True)


def test_structure_of_constant_images_has_its_closed_form() -> None:
    """Only SSIM's luminance term differs from 1, on every scale."""
    a, b = 0.3, 0.7
    value = Structure()(*(torch.full((1, 3, 48, 96), c, dtype=torch.float64) for c in (a, b)))
    luminance = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert float(value) == pytest.approx((1 - luminance) / 2, abs=1e-9)


def test_ssim_inside_the_image_equals_the_metric() -> None:
    """Only windows inside the image are compared; the metric's (co)variances are 121/120 of ours."""
    from pansplat.evaluation.metrics import ssim

    prediction, target = (image[0] for image in random_images(32))
    ours = float(ssim_map(prediction[None], target[None])[..., 5:-5, 5:-5].mean())
    assert ours == pytest.approx(ssim(prediction, target), abs=2e-3)


@pytest.mark.shared
def test_auto_selects_lpips_if_its_files_exist_and_structure_otherwise(shared, tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("PANSPLAT_LPIPS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert choose_perceptual("auto").name == "structure"
    assert choose_perceptual("auto", shared / "weights").name == "lpips-squeeze"
    assert choose_perceptual("structure", shared / "weights").name == "structure"
    expect_error("LPIPS with vgg needed", choose_perceptual, "lpips-vgg")


def test_depth_losses_have_their_closed_forms() -> None:
    """The errors of constant depths are sums over the levels; a coarser level has a smaller weight."""
    truth = torch.full((1, 2, 32, 64), 2.0, dtype=torch.float64)
    levels = [torch.full((1, 2, h, 2 * h), d, dtype=torch.float64) for h, d in ((4, 5.0), (8, 4.0), (16, 2.5))]
    metres = depth_loss(levels, truth, NEAR, FAR, form="depth")
    assert float(metres) == pytest.approx(0.9**2 * 3.0 + 0.9 * 2.0 + 0.5)
    inverse = depth_loss(levels, truth, NEAR, FAR, form="inverse_depth")
    assert float(inverse) == pytest.approx(0.9**2 * 0.3 + 0.9 * 0.25 + 0.1)
    halved = depth_loss(levels, truth, NEAR, FAR, form="depth", decay=0.5)
    assert float(halved) == pytest.approx(0.25 * 3.0 + 0.5 * 2.0 + 0.5)


@pytest.mark.parametrize("form", ["depth", "inverse_depth"])
@pytest.mark.parametrize("unknown", [0.0, NEAR, FAR, math.inf])
def test_depth_outside_the_range_is_unknown(form, unknown: float) -> None:
    (level,), (truth,) = depths(16), depths(16, seed=1)
    expected = float(depth_loss([level[..., :8, :]], truth[..., :8, :], NEAR, FAR, form=form))
    truth[..., 8:, :] = unknown
    level.requires_grad_()
    loss = depth_loss([level], truth, NEAR, FAR, form=form)
    assert loss.item() == pytest.approx(expected)
    loss.backward()
    assert level.grad is not None and torch.isfinite(level.grad).all() and not level.grad[..., 8:, :].any()


@pytest.mark.parametrize("form", ["depth", "inverse_depth"])
def test_masked_depth_and_that_beyond_a_views_range_do_not_affect_the_loss(form) -> None:
    (level,), (truth,) = depths(16), depths(16, seed=1)
    far = torch.tensor([[FAR, 0.9]], dtype=torch.float64)  # largest depths; all depths of the second view are larger
    both = depth_loss([level], truth, torch.full_like(far, NEAR), far, form=form)
    assert float(both) == pytest.approx(float(depth_loss([level[:, :1]], truth[:, :1], NEAR, FAR, form=form)))
    masks = torch.ones(1, 2, 16, 32, dtype=torch.bool)
    masks[..., 8:, :] = False
    part = depth_loss([level[..., :8, :]], truth[..., :8, :], NEAR, FAR, form=form)
    masked = depth_loss([level], truth, NEAR, FAR, form=form, masks=masks)
    assert float(masked) == pytest.approx(float(part))
    nothing = depth_loss([level], truth, NEAR, FAR, form=form, masks=torch.zeros_like(masks))
    assert float(nothing) == 0


def test_true_depth_is_downsampled_without_interpolation() -> None:
    """Columns alternate between 2 and 6 metres; interpolation would give 4."""
    truth = torch.full((1, 1, 16, 32), 2.0, dtype=torch.float64)
    truth[..., 1::2] = 6.0
    level = truth[..., ::2, 1::2]
    assert float(depth_loss([level], truth, NEAR, FAR, form="depth")) == 0


@pytest.mark.parametrize("form", ["depth", "inverse_depth"])
def test_depth_losses_have_the_gradients_of_finite_differences(form) -> None:
    levels, (truth,) = depths(2, 4, 8), depths(16, seed=1)
    truth[..., 3:5, :] = 0

    def loss(*levels: Tensor) -> Tensor:
        return depth_loss(levels, truth, NEAR, FAR, form=form)

    assert torch.autograd.gradcheck(loss, [level.requires_grad_() for level in levels])


def test_the_auxiliary_loss_sums_the_levels_image_losses() -> None:
    target = torch.full((1, 3, 8, 16), 0.5, dtype=torch.float64)
    rendered = [target + error for error in (0.4, 0.2, 0.1)]
    weights = LossWeights(perceptual=0.5)
    parts = [error**2 + 0.5 * error for error in (0.4, 0.2, 0.1)]
    distance = lambda image, target, weights: (image.mean(dim=(1, 2, 3)) - target.mean(dim=(1, 2, 3))).abs()  # noqa: E731
    value = float(auxiliary_loss(rendered, target, distance, weights))
    assert value == pytest.approx(0.9**2 * parts[0] + 0.9 * parts[1] + parts[2])
