"""The metrics are the official protocol's, by value, and behave as metrics should."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from pansplat.evaluation.metrics import psnr, ssim, ws_psnr
from pansplat.geometry.equirect import row_weights

METRICS = {"psnr": psnr, "ws_psnr": ws_psnr, "ssim": ssim}


@pytest.fixture(scope="module")
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(3)
    target = torch.rand(3, 32, 64, generator=random)
    return (target + 0.1 * torch.randn(3, 32, 64, generator=random)).clamp(0, 1), target


@pytest.mark.shared
@pytest.mark.parametrize("name", METRICS)
def test_equals_the_official_value(shared: Path, name: str) -> None:
    golden = load_file(shared / "golden" / "units.safetensors")
    for i in range(2):
        value = METRICS[name](golden["metric.pred"][i], golden["metric.gt"][i])
        official = float(golden[f"metric.{name}"][i])
        # dB of float32 sums agree to 1e-5; SSIM to 1e-6
        assert value == pytest.approx(official, abs=1e-6 if name == "ssim" else 2e-5)


def test_equal_images_are_perfect(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    _, target = pair
    assert psnr(target, target) == math.inf
    assert ws_psnr(target, target) == math.inf
    assert ssim(target, target) == pytest.approx(1.0, abs=1e-12)


def test_an_error_of_a_tenth_is_twenty_decibels() -> None:
    target = torch.full((3, 16, 32), 0.5, dtype=torch.float64)
    assert psnr(target + 0.1, target) == pytest.approx(20.0)
    assert ws_psnr(target - 0.1, target) == pytest.approx(20.0)


def test_only_psnr_clamps() -> None:
    target = torch.ones(3, 16, 32)
    assert psnr(target + 0.5, target) == math.inf
    assert ws_psnr(target + 0.5, target) == pytest.approx(-20 * math.log10(0.5))


def test_a_pole_row_counts_by_its_solid_angle() -> None:
    height = 16
    target = torch.zeros(3, height, 32, dtype=torch.float64)
    weights = row_weights(height)
    for row in (0, height // 2):
        wrong = target.clone()
        wrong[:, row] = 1.0
        share = float(weights[row] / weights.sum())
        assert ws_psnr(wrong, target) == pytest.approx(-10 * math.log10(share))
        assert psnr(wrong, target) == pytest.approx(-10 * math.log10(1 / height))


def test_masked_pixels_do_not_count(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    _, target = pair
    wrong = target.clone()
    wrong[:, 20:] = 0.0
    mask = torch.ones(32, 64, dtype=torch.bool)
    mask[20:] = False
    assert psnr(wrong, target, mask=mask) == math.inf
    assert ws_psnr(wrong, target, mask=mask) == math.inf
    assert psnr(wrong, target) < 20
    assert math.isnan(psnr(wrong, target, mask=torch.zeros_like(mask)))


def test_ssim_of_constant_images_is_its_closed_form() -> None:
    """Without structure only the luminance term is left."""
    a, b = 0.3, 0.7
    value = ssim(*(torch.full((3, 20, 40), c, dtype=torch.float64) for c in (a, b)))
    assert value == pytest.approx((2 * a * b + 1e-4) / (a * a + b * b + 1e-4), abs=1e-9)


def test_metrics_are_symmetric(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    for metric in METRICS.values():
        assert metric(*pair) == pytest.approx(metric(*reversed(pair)))


@pytest.mark.parametrize("metric", METRICS.values())
def test_unequal_shapes_are_refused(metric, unchecked: None) -> None:
    with pytest.raises(ValueError, match=r"must both be \(3, height, width\), got \(3, 16, 32\) and \(3, 8, 16\)"):
        metric(torch.zeros(3, 16, 32), torch.zeros(3, 8, 16))


def test_a_mask_of_another_size_is_refused(unchecked: None) -> None:
    image = torch.zeros(3, 16, 32)
    with pytest.raises(ValueError, match=r"`mask` must be \(16, 32\)"):
        psnr(image, image, mask=torch.ones(8, 16, dtype=torch.bool))


def test_ssim_needs_a_window() -> None:
    with pytest.raises(ValueError, match="larger than 10 x 10"):
        ssim(torch.zeros(3, 10, 20), torch.zeros(3, 10, 20))
