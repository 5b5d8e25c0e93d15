"""Textures are averaged over a pixel: no aliasing, and the same mean at every pixel size."""

import numpy as np
import pytest

from pansplat_homes.textures import NUMBERS, Pattern, color, fractal, hash_unit, pulse


@pytest.mark.parametrize(("share", "w"), [(0.3, 0.2), (0.1, 0.7), (0.5, 0.99), (0.25, 0.01)])
def test_a_filtered_pulse_is_the_mean_of_unfiltered_ones(share: float, w: float) -> None:
    for x in np.linspace(-1.3, 2.1, 7):
        fine = np.mean([pulse(x + offset, share, 0.0) for offset in (np.arange(4000) + 0.5) / 4000 * w - w / 2])
        assert pulse(x, share, w) == pytest.approx(fine, abs=2e-3)


def test_hashes_are_uniform_and_reproducible() -> None:
    values = np.array([hash_unit(i, j, 3) for i in range(-40, 40) for j in range(-40, 40)])
    assert values.min() >= 0 and values.max() < 1
    assert np.allclose(np.histogram(values, 10, (0, 1))[0] / values.size, 0.1, atol=0.02)
    assert hash_unit(1, 2, 3) != hash_unit(2, 1, 3)


def test_noise_finer_than_a_pixel_is_omitted() -> None:
    places = np.linspace(0, 3, 200)
    assert np.std([fractal(u, 0.2, 0.1, 5, 0.0, 1) for u in places]) > 0.1
    assert np.std([fractal(u, 0.2, 0.1, 5, 1.0, 1) for u in places]) == 0


@pytest.mark.parametrize("pattern", list(Pattern))
def test_reflectances_are_bounded_and_vary_less_at_large_pixels(pattern: Pattern) -> None:
    material = np.zeros(NUMBERS)
    material[:16] = [pattern, 0.8, 0.7, 0.6, 0.1, 0.2, 0.1, 0.4, 0.1, 0.2, 0.1, 0.1, 0.1, 0.1, 7, 0]
    places = np.random.default_rng(0).uniform(-0.5, 0.5, size=(400, 2))
    near, far = (np.array([color(material, u, v, w, 0.5, 0.5) for u, v in places]) for w in (0.002, 0.6))
    assert np.isfinite(near).all() and np.isfinite(far).all()
    assert near.min() >= -1e-9 and near.max() < 2.5
    if pattern not in (Pattern.PLAIN, Pattern.PICTURE):
        assert far.std(axis=0).mean() < 0.6 * near.std(axis=0).mean()
