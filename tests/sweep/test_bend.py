"""Surfaces of single views that are bent by matches."""

import dataclasses
import math

import numpy as np
import pytest

from pansplat.geometry.equirect import row_weights
from pansplat.sweep import bend
from pansplat.sweep.bend import bend_surfaces, fit_field, measure_evidence
from pansplat.sweep.surface import Surface

HEIGHT = 48
SHAPE = (HEIGHT, 2 * HEIGHT)


def _surface(depth: np.ndarray) -> Surface:
    return Surface((1 / depth).astype(np.float32))


def _area() -> np.ndarray:
    return np.repeat(row_weights(HEIGHT).numpy()[:, None], 2 * HEIGHT, axis=1)


def test_without_evidence_only_the_scale_changes():
    target = np.random.default_rng(2).normal(0.4, 0.3, SHAPE)
    field = fit_field(target, np.zeros(SHAPE), np.zeros(SHAPE))
    assert np.ptp(field) < 1e-12 and abs(field[0, 0] - 0.4) < 0.03


def test_a_field_does_not_cross_a_discontinuity_of_the_single_view():
    rows, columns = np.indices(SHAPE)
    is_near = (np.abs(rows - HEIGHT / 2) < 10) & (np.abs(columns - HEIGHT) < 14)
    log_depth = np.where(is_near, 0.0, 1.5)
    target = np.where(is_near, 0.25, 0.0)
    evidence = (np.random.default_rng(4).random(SHAPE) < 0.3).astype(float)
    field = fit_field(target, evidence, log_depth)
    assert np.abs(field - target)[4:-4].max() < 0.03
    blurred = fit_field(target, evidence, np.zeros(SHAPE))
    assert np.abs(blurred - target)[4:-4].max() > 0.06, "without the discontinuity it does"


def test_rolling_the_panorama_rolls_the_field():
    generator = np.random.default_rng(5)
    target, evidence, log_depth = (generator.random(SHAPE) for _ in range(3))
    field = fit_field(target, evidence, 0.1 * log_depth)
    rolled = fit_field(*(np.roll(m, 37, axis=1) for m in (target, evidence, 0.1 * log_depth)))
    assert np.allclose(np.roll(field, 37, axis=1), rolled, atol=1e-9)


@pytest.mark.parametrize("box", [None, ((0.9, 0.2, 0.6), (1.6, 1.2, 1.4))])
def test_evidence_is_where_both_views_have_the_true_surface(make_room, box, monkeypatch):
    room = make_room(box=box)
    observed = room.observe(HEIGHT)
    surfaces = [_surface(depth) for depth in observed.depths]
    monkeypatch.setattr(bend, "_FULL_PARALLAX", 0.05)
    evidence = measure_evidence(observed.posed, surfaces, 0, [1])
    assert (evidence * _area()).sum() / _area().sum() > 0.6
    wrong = [surfaces[0], _surface(1.3 * observed.depths[1])]
    assert measure_evidence(observed.posed, wrong, 0, [1]).mean() < 0.1
    masked = dataclasses.replace(observed.posed, masks=np.zeros_like(observed.posed.masks))
    assert not measure_evidence(masked, surfaces, 0, [1]).any()


def test_a_distorted_single_view_is_bent_to_the_true_surface(make_room):
    """The single view has the room at another scale, and its walls too far; the search has false matches."""
    observed = make_room().observe(HEIGHT)
    generator = np.random.default_rng(6)
    false = np.where(generator.random(observed.depths.shape) < 0.05, 0.5, 1.0)
    found = [_surface(depth) for depth in observed.depths * false]
    columns = np.arange(2 * HEIGHT)
    log_depths = [np.log(2 * depth) + 0.12 * np.sin(2 * math.pi * columns / len(columns)) for depth in observed.depths]
    bent = bend_surfaces(observed.posed, found, [[1], [0]], log_depths)
    for surface, depth, before in zip(bent, observed.depths, log_depths, strict=True):
        error = np.abs(np.log(surface.inverse_depth * depth))
        scaled = np.abs(before - np.median(before - np.log(depth)) - np.log(depth))
        assert np.median(error) < 0.015 < 0.05 < np.median(scaled)
        assert np.quantile(error, 0.98) < 0.08
