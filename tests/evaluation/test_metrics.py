"""The metrics equal the official protocol's, by value; the cross-fade has its closed forms."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from synthetic_scenes import place_cameras, turn_camera

from pansplat.evaluation.metrics import cross_fade, distortion, psnr, ssim, ws_psnr
from pansplat.geometry.equirect import pixel_directions, row_weights

METRICS = {"psnr": psnr, "ws_psnr": ws_psnr, "ssim": ssim}


@pytest.fixture(scope="module")
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(3)
    target = torch.rand(3, 32, 64, generator=random)
    return (target + 0.1 * torch.randn(3, 32, 64, generator=random)).clamp(0, 1), target


@pytest.mark.shared
@pytest.mark.parametrize("name", METRICS)
def test_metrics_equal_the_official_values(shared: Path, name: str) -> None:
    golden = load_file(shared / "golden" / "units.safetensors")
    for i in range(2):
        value = METRICS[name](golden["metric.pred"][i], golden["metric.gt"][i])
        official = float(golden[f"metric.{name}"][i])
        # dB of float32 sums agree to 1e-5; SSIM to 1e-6
        assert value == pytest.approx(official, abs=1e-6 if name == "ssim" else 2e-5)


def test_equal_images_are_perfect_and_metrics_are_symmetric(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    target = pair[1]
    assert psnr(target, target) == ws_psnr(target, target) == math.inf
    assert ssim(target, target) == pytest.approx(1.0, abs=1e-12)
    for metric in METRICS.values():
        assert metric(*pair) == pytest.approx(metric(*reversed(pair)))


def test_an_error_of_a_tenth_is_twenty_decibels_and_only_psnr_clamps() -> None:
    target = torch.full((3, 16, 32), 0.5, dtype=torch.float64)
    assert psnr(target + 0.1, target) == pytest.approx(20.0) == ws_psnr(target - 0.1, target)
    assert psnr(2 * target + 0.5, 2 * target) == math.inf
    assert ws_psnr(2 * target + 0.5, 2 * target) == pytest.approx(-20 * math.log10(0.5))


def test_ws_psnr_weights_rows_by_solid_angle() -> None:
    height = 16
    target = torch.zeros(3, height, 32, dtype=torch.float64)
    weights = row_weights(height)
    for row in (0, height // 2):
        wrong = target.clone()
        wrong[:, row] = 1.0
        share = float(weights[row] / weights.sum())
        assert ws_psnr(wrong, target) == pytest.approx(-10 * math.log10(share))
        assert psnr(wrong, target) == pytest.approx(-10 * math.log10(1 / height))


def test_masked_pixels_are_ignored(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    _, target = pair
    wrong = target.clone()
    wrong[:, 20:] = 0.0
    mask = torch.ones(32, 64, dtype=torch.bool)
    mask[20:] = False
    assert ws_psnr(wrong, target, mask=mask) == math.inf > 20 > ws_psnr(wrong, target)
    assert math.isnan(ws_psnr(wrong, target, mask=torch.zeros_like(mask)))


def test_images_and_masks_that_do_not_fit_are_refused(unchecked: None) -> None:
    image, small = torch.zeros(3, 16, 32), torch.zeros(3, 8, 16)
    for metric in METRICS.values():
        with pytest.raises(ValueError, match=r"must both be \(3, height, width\), got \(3, 16, 32\) and \(3, 8, 16\)"):
            metric(image, small)
    with pytest.raises(ValueError, match=r"`mask` must be \(16, 32\)"):
        ws_psnr(image, image, mask=torch.ones(8, 16, dtype=torch.bool))
    with pytest.raises(ValueError, match="larger than 10 x 10"):
        ssim(image[:, :10], image[:, :10])


def render_sky(pose: torch.Tensor, height: int = 64) -> torch.Tensor:
    """A panorama of smooth colours at infinity."""
    directions = pixel_directions(height, 2 * height, dtype=torch.float64) @ pose[:3, :3].T
    return (0.5 + 0.4 * torch.sin(2 * directions + directions.roll(1, -1))).permute(2, 0, 1).float()


def test_the_cross_fade_is_exact_for_a_scene_at_infinity() -> None:
    poses = [turn_camera((0.9, 0.2, 0.4, -0.1), (0, 0, 0)), turn_camera((0.3, -0.8, 0.1, 0.5), (1, 0, 0))]
    target = turn_camera((0.7, 0.1, -0.6, 0.3), (0.3, 0, 0))
    faded = cross_fade(torch.stack([render_sky(p) for p in poses]), torch.stack(poses), target)
    assert float((faded - render_sky(target)).abs().max()) < 5e-3  # bilinear sampling


def test_the_cross_fade_weights_inputs_by_distance() -> None:
    images = torch.stack((torch.zeros(3, 8, 16), torch.ones(3, 8, 16)))
    for place in (0.0, 0.25):
        faded = cross_fade(images, place_cameras((0, 0, 0), (1, 0, 0)), *place_cameras((place, 0, 0)))
        torch.testing.assert_close(faded, torch.full((3, 8, 16), place), atol=1e-5, rtol=0)


ROWS = 128
SPHERE = torch.full((ROWS, 2 * ROWS), 0.5, dtype=torch.float64)  # inverse depth at 2 m
RAYS = pixel_directions(ROWS, 2 * ROWS, dtype=torch.float64)
AHEAD = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
HALF = 0.5 * AHEAD


def tear(jump: float) -> torch.Tensor:
    """The sphere with blocks of 8 x 8 pixels at random distances, up to `jump` of theirs nearer or farther."""
    blocks = torch.rand(ROWS // 8, ROWS // 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return SPHERE * (1 + jump * (2 * blocks - 1)).repeat_interleave(8, 0).repeat_interleave(8, 1)


def test_smooth_surfaces_and_planes_are_not_distorted() -> None:
    assert max(distortion(SPHERE, HALF, AHEAD)) < 1e-3
    assert max(distortion(SPHERE, torch.tensor((0.3, 1.2, 0.1)), AHEAD)) < 1e-3  # towards a pole
    wall = (RAYS @ AHEAD / 2).clamp(min=1e-3)
    assert distortion(wall, HALF, AHEAD)[0] < 1e-3  # its edge is 90 degrees from ahead


def test_distortion_grows_with_tears_and_is_zero_without_motion() -> None:
    ahead, aside = zip(*(distortion(tear(jump), HALF, AHEAD) for jump in (0, 0.05, 0.2, 0.6)), strict=True)
    assert list(ahead) == sorted(ahead) and ahead[-1] > 0.1 and list(aside) == sorted(aside) and aside[1] > 0.03
    assert all(wide > narrow for wide, narrow in zip(aside[1:], ahead[1:], strict=True))  # parallax is larger there
    assert max(distortion(tear(0.6), 0 * HALF, AHEAD)) < 1e-3


def test_distortion_turns_with_the_axes_and_is_counted_near_the_direction_of_the_flight() -> None:
    torn, offset = tear(0.3), torch.tensor((0.1, -0.05, 0.4), dtype=torch.float64)
    turned = torch.tensor(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)), dtype=torch.float64)  # a quarter to the right
    rolled = distortion(torn.roll(ROWS // 2, dims=1), turned @ offset, turned @ (AHEAD + 3 * offset))
    assert rolled == pytest.approx(distortion(torn, offset, AHEAD + 3 * offset), abs=1e-9)
    half = torch.where(RAYS[..., 2] > 0.7, torn, SPHERE)
    assert distortion(half, 0.2 * AHEAD, AHEAD)[0] > 0.01 > distortion(half, 0.2 * AHEAD, AHEAD)[1]


def test_places_without_surface_do_not_count() -> None:
    holes = torch.where(RAYS[..., 0] > 0, torch.nan, SPHERE)
    assert max(distortion(holes, HALF, AHEAD)) < 1e-3
    assert all(map(math.isnan, distortion(torch.full_like(SPHERE, torch.nan), HALF, AHEAD)))
