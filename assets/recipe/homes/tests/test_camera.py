"""Each camera effect does what its strength says, nothing else, and can be switched off."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pansplat.geometry.equirect import pixel_directions
from pansplat.images.image_files import linear_from_srgb, srgb_from_linear
from pansplat_homes.camera import NO_EFFECTS, CameraEffects, Photographs, photograph

HEIGHT = 64
STRENGTHS = [field.name for field in fields(CameraEffects)]
TEXTURE = np.random.default_rng(0).uniform(0.05, 0.9, (2, HEIGHT, 2 * HEIGHT, 3)).astype(np.float32)
DEPTH = np.full((2, HEIGHT, 2 * HEIGHT), 1.5, np.float32)
DIRECTIONS = pixel_directions(HEIGHT, 2 * HEIGHT).numpy()


def take(light: np.ndarray, seed: int = 0, depth: np.ndarray = DEPTH, **strengths: object) -> Photographs:
    """Photographs with only the given effects."""
    effects = replace(NO_EFFECTS, **strengths)  # type: ignore[arg-type]
    return photograph(light.astype(np.float32), depth, np.random.default_rng(seed), effects)


def grey(value: float) -> np.ndarray:
    return np.full((2, HEIGHT, 2 * HEIGHT, 3), value, np.float32)


def test_without_effects_a_photograph_is_the_light_in_srgb() -> None:
    images, masks, exposures = photograph(3 * TEXTURE, DEPTH, np.random.default_rng(0), NO_EFFECTS)
    np.testing.assert_allclose(images, srgb_from_linear(3 * TEXTURE), atol=2e-5)
    assert masks.all() and (exposures == 1).all()


@pytest.mark.parametrize("name", STRENGTHS)
def test_each_effect_alone_changes_the_images(name: str) -> None:
    needed = {"cap_degrees": {"nadir_probability": 1.0}, "zenith_probability": {"cap_degrees": 25.0}}
    strength = needed.get(name, {})
    strength |= {name: 1.0 if "probability" in name else getattr(CameraEffects(), name)}
    light = TEXTURE * np.array((0.5, 8), np.float32)[:, None, None, None]
    plain = srgb_from_linear(light)
    images = [take(light, seed, **strength).images for seed in range(3)]
    assert max(np.abs(image - plain).max() for image in images) > 0.01
    assert all(image.min() >= 0 and image.max() <= 1 for image in images)


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e30, np.inf])
def test_images_of_extreme_light_are_finite(value: float) -> None:
    light = grey(0.3)
    light[0], light[1, 10:30, 100:] = value, value
    for seed in range(4):
        images = photograph(light, DEPTH, np.random.default_rng(seed)).images
        assert images.dtype == np.float32 and np.isfinite(images).all()
        assert images.min() >= 0 and images.max() <= 1


@pytest.mark.parametrize("height", [16, 33, 96])
def test_any_height_is_photographed(height: int) -> None:
    light, depth = np.full((1, height, 2 * height, 3), 0.3, np.float32), np.ones((1, height, 2 * height))
    for seed in range(8):
        images, masks, _ = photograph(light, depth, np.random.default_rng(seed))
        assert images.shape == light.shape and masks.shape == depth.shape


def test_photographs_are_determined_by_the_generator_and_keep_the_light() -> None:
    light = TEXTURE.copy()
    first, again, other = (photograph(light, DEPTH, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(first.images, again.images) and np.array_equal(first.masks, again.masks)
    assert not np.array_equal(first.images, other.images)
    assert np.array_equal(light, TEXTURE)


# ---- exposure and white balance


def test_darker_views_are_exposed_longer_by_at_most_the_stated_stops() -> None:
    light = np.concatenate((grey(0.02), grey(2.0)))[1:3]
    stops = np.array([np.diff(np.log2(take(light, seed, exposure_stops=0.7).exposures)) for seed in range(40)])
    assert stops.max() < 0.2 and stops.mean() < -0.2 and -0.7 - 1e-9 <= stops.min() < -0.6
    assert np.ptp(take(light, exposure_stops=0.0).exposures) == 0
    for seed in range(10):  # views of dark and bright rooms to a limited difference
        exposures = take(light / np.reshape((10, 1), (2, 1, 1, 1)), seed, exposure_stops=0.7, room_stops=1.0).exposures
        np.testing.assert_allclose(exposures * (0.002, 2.0), 0.002**0.5 * 2**0.5 * np.array((0.5, 2)), rtol=1e-3)


@pytest.mark.parametrize("value", [0.003, 0.3, 40.0])
def test_automatic_exposure_maps_the_light_into_its_range(value: float) -> None:
    values = [linear_from_srgb(take(grey(value), seed, grey=(0.1, 0.2)).images).mean() for seed in range(10)]
    assert min(values) > 0.099 and max(values) < 0.201
    assert max(values) - min(values) > 0.05


def test_white_balance_stays_within_its_limits() -> None:
    for seed in range(20):
        light = linear_from_srgb(take(grey(0.2), seed, tour_white_balance=0.15, view_white_balance=0.04).images)
        gains = light[:, 0, 0] / light[:, 0, 0, 1:2]
        assert np.abs(gains - 1).max() < 0.1905
        assert np.abs(gains[0] - gains[1]).max() < 0.0805
        tour = linear_from_srgb(take(grey(0.2), seed, tour_white_balance=0.15).images)
        assert np.array_equal(tour[0], tour[1])


# ---- lenses, seams and pose


def test_lenses_differ_by_at_most_the_stated_exposure_and_wrap() -> None:
    for seed in range(10):
        light = linear_from_srgb(take(grey(0.2), seed, lens_exposure=0.05).images)[0, :, :, 0] / 0.2
        assert light.min() > 0.9499 and light.max() < 1.0501
        assert np.ptp(light) > 1e-3
        steps = np.abs(np.diff(light, axis=1, append=light[:, :1]))
        assert steps.max() < 0.1
        assert steps[:, -1].max() <= 1.5 * steps[:, :-1].max()


def test_vignetting_darkens_only_near_seams() -> None:
    for seed in range(10):
        loss = 1 - linear_from_srgb(take(grey(0.2), seed, vignetting=0.25).images)[0, :, :, 0] / 0.2
        assert loss.min() > -1e-4 and loss.max() < 0.2501
        horizon = loss[HEIGHT // 2]
        assert horizon.max() > 2 * np.median(horizon)


def _shown_directions(**strengths: float) -> np.ndarray:
    """Directions in the scene of the pixels of photographs, (seed view h w 3)."""
    light = np.stack([0.5 + 0.4 * DIRECTIONS] * 2)
    shown = np.stack([(linear_from_srgb(take(light, seed, **strengths).images) - 0.5) / 0.4 for seed in range(12)])
    return shown / np.linalg.norm(shown, axis=-1, keepdims=True)


def _degrees(shown: np.ndarray) -> np.ndarray:
    """Angles between shown directions and those of the pixels."""
    return np.degrees(np.arccos(np.clip((shown * DIRECTIONS).sum(axis=-1), -1, 1)))


def test_views_are_rotated_by_at_most_the_stated_angle() -> None:
    angles = _degrees(_shown_directions(pose_degrees=0.3))
    assert 0.15 < angles.max() < 0.34
    assert np.abs(angles[:, 0] - angles[:, 1]).max() > 0.05


def test_views_are_rotated_rigidly_up_to_the_poles_and_the_border() -> None:
    for shown in _shown_directions(pose_degrees=20.0).reshape(-1, HEIGHT, 2 * HEIGHT, 3):
        left, _, right = np.linalg.svd(shown.reshape(-1, 3).T @ DIRECTIONS.reshape(-1, 3))
        cosine = (shown * (DIRECTIONS @ (left @ right).T)).sum(axis=-1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1.5  # half a pixel


def test_seams_are_misaligned_by_at_most_the_stated_angle_and_only_near_them() -> None:
    shown = _shown_directions(seam_shift_degrees=1.0)
    angles = _degrees(shown)
    assert angles.max() < 1.15  # a degree across the seam and half a degree along it
    assert angles.max() > 0.3
    assert np.median(angles, axis=-1).max() < 0.1 * angles.max()
    assert np.degrees(np.abs(shown - DIRECTIONS)[:, :, HEIGHT // 2, :, 1]).max() > 0.1
    assert np.array_equal(angles[:, 0], angles[:, 1])


@pytest.mark.parametrize("name", ["flare", "local_contrast", "sharpening", "softness"])
def test_rolling_the_panorama_rolls_the_photograph(name: str) -> None:
    light = TEXTURE * np.linspace(0.1, 3, 2 * HEIGHT, dtype=np.float32)[:, None]
    strength = {name: getattr(CameraEffects(), name)}
    for seed in range(4):
        rolled = take(np.roll(light, HEIGHT, axis=2), seed, **strength).images
        np.testing.assert_allclose(rolled, np.roll(take(light, seed, **strength).images, HEIGHT, axis=2), atol=1e-5)


# ---- light to display values


def test_flare_moves_light_from_a_window_to_its_surroundings() -> None:
    light = grey(0.02)
    light[:, 24:36, 40:56] = 0.95
    near, far = (slice(None), 20, 48), (slice(None), 30, 120)
    gains = []
    for seed in range(20):
        images = linear_from_srgb(take(light, seed, flare=0.5).images)
        assert images[near].min() >= images[far].max() >= 0.02 * 0.5
        assert images[:, 30, 48].max() < 0.951
        np.testing.assert_allclose(images.mean(), light.mean(), rtol=0.02)
        gains.append(images[near].max())
    assert max(gains) > 0.04


def test_local_contrast_brings_dark_and_bright_regions_together() -> None:
    light = TEXTURE * 0.2
    light[:, :, HEIGHT:] *= 16
    ratios = []
    for seed in range(12):
        images = linear_from_srgb(take(light, seed, local_contrast=0.65).images)
        ratios.append(images[:, :, HEIGHT + 8 : -8].mean() / images[:, :, 8 : HEIGHT - 8].mean())
    plain = linear_from_srgb(srgb_from_linear(light))
    assert min(ratios) < 0.5 * plain[:, :, HEIGHT:].mean() / plain[:, :, :HEIGHT].mean()
    assert min(ratios) > 1


@pytest.mark.parametrize("name", ["gamma", "shoulder", "contrast"])
def test_tone_curves_keep_the_order_of_light(name: str) -> None:
    ramp = np.repeat(np.geomspace(1e-5, 60, 2 * HEIGHT, dtype=np.float32)[:, None], 3, axis=1)
    light = np.broadcast_to(ramp, grey(0).shape)
    for seed in range(10):
        images = take(light, seed, **{name: getattr(CameraEffects(), name)}).images
        assert (np.diff(images, axis=2) >= 0).all()
        assert images.min() < 0.02 and images.max() > 0.999


def test_saturation_keeps_grey_and_pale_tours_are_almost_grey() -> None:
    for seed in range(5):
        np.testing.assert_allclose(
            take(grey(0.3), seed, saturation=0.35).images, srgb_from_linear(grey(0.3)), atol=1e-4
        )
        images = take(TEXTURE, seed, pale_probability=1.0).images
        assert np.ptp(images, axis=-1).mean() < 0.45 * np.ptp(srgb_from_linear(TEXTURE), axis=-1).mean()


def test_noise_at_mid_grey_is_at_most_the_stated_deviation() -> None:
    deviations = [float(take(grey(0.2), seed, noise=0.02).images.std()) for seed in range(12)]
    assert max(deviations) < 0.025
    assert max(deviations) > 0.008


def test_sharpening_raises_and_softness_lowers_the_variance() -> None:
    plain = srgb_from_linear(0.2 + 0.2 * TEXTURE)
    for seed in range(6):
        assert take(0.2 + 0.2 * TEXTURE, seed, sharpening=0.5).images.std() > plain.std()
        assert take(0.2 + 0.2 * TEXTURE, seed, softness=0.5).images.std() < plain.std()


def test_jpeg_images_have_eight_bits() -> None:
    values = take(TEXTURE, jpeg_quality=(90, 98)).images * 255
    np.testing.assert_allclose(values, np.round(values), atol=1e-3)
    errors = [np.abs(take(TEXTURE, jpeg_quality=(q, q)).images - srgb_from_linear(TEXTURE)).mean() for q in (50, 95)]
    assert errors[0] > errors[1] > 0


# ---- what is fixed to the camera


def test_covers_are_at_the_pole_equal_in_all_views_and_masked_unless_they_resemble_the_scene() -> None:
    """On a white floor, shadows take away at most half of the light, and blurred poles are white."""
    plain, rows, black_caps = srgb_from_linear(TEXTURE), [], 0
    floor = grey(1)
    floor[:, : HEIGHT // 2] = 0
    for seed in range(60):
        images, masks, _ = take(TEXTURE, seed, nadir_probability=1.0, cap_degrees=25.0)
        assert np.array_equal(masks[0], masks[1])
        assert masks[:, : HEIGHT * 3 // 4].all()
        np.testing.assert_allclose(images[:, : HEIGHT // 2], plain[:, : HEIGHT // 2], atol=2e-5)
        rows.append(int((~masks[0].all(axis=1)).sum()))
        black = (images == 0).all(axis=-1)
        if black.any():
            black_caps += 1
            assert np.array_equal(black, ~masks)
            assert black[:, -1].all() and not black[:, : HEIGHT - 9].any()
            np.testing.assert_allclose(images[masks], plain[masks], atol=2e-5)
        images, masks, _ = take(floor, seed, nadir_probability=1.0, cap_degrees=25.0)
        assert images[:, HEIGHT // 2 :][masks[:, HEIGHT // 2 :]].min() > 0.44
    assert min(rows) == 0 and max(rows) > 4  # blurred poles count as scene
    assert black_caps > 2


def test_blurred_poles_resemble_the_scene() -> None:
    light = grey(0.4) + 0.3 * DIRECTIONS / np.hypot(DIRECTIONS[..., :1], DIRECTIONS[..., 2:])
    light[..., 1] = 0.4
    seen = 0
    for seed in range(40):
        images, masks, _ = take(light, seed, nadir_probability=1.0, cap_degrees=25.0)
        change = np.abs(images - srgb_from_linear(light)).max(axis=-1)[:, HEIGHT * 3 // 4 :]
        if masks.all():
            seen += 1
            assert 0 < np.median(change[change > 1e-3]) < 0.25
    assert seen > 4


def test_the_operator_is_masked_and_hidden_behind_near_surfaces() -> None:
    for seed in range(5):
        images, masks, _ = take(TEXTURE, seed, operator_probability=1.0)
        assert 0.005 < 1 - masks.mean() < 0.3
        np.testing.assert_allclose(images[masks], srgb_from_linear(TEXTURE)[masks], atol=2e-5)
        assert take(TEXTURE, seed, depth=0.01 * DEPTH, operator_probability=1.0).masks.all()
