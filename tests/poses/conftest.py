"""Synthetic bearings of points that two cameras see."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy import ndarray as Array

from pansplat.poses.solvers import rotation_exp


@dataclass(frozen=True)
class Bearings:
    """Bearings of the same points from two cameras, x2 = R x1 + t; the last ones are outliers."""

    first: Array
    second: Array
    rotation: Array
    translation: Array


Scene = Callable[..., Bearings]


@pytest.fixture(scope="session")
def scene() -> Scene:
    """A function that makes bearings; rotation and translation are random unless they are given."""

    def make(
        seed: int = 0,
        count: int = 200,
        *,
        noise: float = 0.0,
        outliers: float = 0.0,
        planar: bool = False,
        upright: bool = False,
        rotation: Array | None = None,
        translation: Array | None = None,
    ) -> Bearings:
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(count, 3))
        points *= rng.uniform(1.5, 6, (count, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
        if planar:  # a wall 2 m ahead
            points = np.concatenate((rng.uniform(-4, 4, (count, 2)), np.full((count, 1), 2.0)), axis=1)
        if rotation is None:
            rotation = rotation_exp(rng.normal(size=3) * (0, 1, 0) if upright else rng.normal(size=3))
        if translation is None:
            translation = rng.normal(size=3)
            translation /= np.linalg.norm(translation)
        second = points @ rotation.T + translation
        bearings = [_unit(points), _unit(second)]
        bearings = [_unit(b + noise * rng.normal(size=b.shape)) for b in bearings]
        wrong = round(outliers * count)
        if wrong:
            bearings[1][-wrong:] = _unit(rng.normal(size=(wrong, 3)))
        return Bearings(bearings[0], bearings[1], rotation, translation)

    return make


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
