"""Tours of synthetic cameras: placing by shared points or by the floor, and contradictions."""

import math

import numpy as np
import pytest

from pansplat.poses.features import Features
from pansplat.poses.solvers import rotation_exp
from pansplat.poses.tour import Pair, Tour, build_tour
from pansplat.poses.two_view import RelativePose

CENTRES = np.array(((0.0, 0, 0), (1.0, 0, 0.2), (1.4, 0, 1.5)))
ROTATIONS = rotation_exp(np.array(((0, 0, 0), (0, 0.5, 0), (0, -0.8, 0.0))))
HEIGHT = 1.5


def _build(shared: bool, pairs: tuple[Pair, ...] = ((0, 1), (1, 2)), turn: float = 0.0, floor: bool = True) -> Tour:
    """The tour by the given pairs, each with own points unless all cameras share them; the last pair may be wrong."""
    rng = np.random.default_rng(0)
    points = [rng.uniform(-4, 4, (60, 3)) for _ in pairs]
    points = [points[0]] * len(pairs) if shared else points
    world = points[0] if shared else np.concatenate(points)
    features = []
    for rotation, centre in zip(ROTATIONS, CENTRES, strict=True):
        rays = (world - centre) @ rotation
        bearings = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        features.append(Features(bearings, np.empty((len(world), 128), np.float32), np.zeros(len(world)), 0.003))
    relations = {}
    for n, (i, j) in enumerate(pairs):
        rotation = ROTATIONS[j].T @ ROTATIONS[i]
        translation = ROTATIONS[j].T @ (CENTRES[i] - CENTRES[j])
        own = np.arange(60) + (0 if shared else 60 * n)
        if n == len(pairs) - 1:
            rotation = rotation_exp(np.array((0, turn, 0))) @ rotation
        direction = translation / np.linalg.norm(translation)
        relations[i, j] = RelativePose(
            rotation, direction, np.stack((own, own), axis=1), 300.0 - n, 99.0, 50.0, 0.5, (1e-3, 1e-3), None
        )

    def floor_height(pair: Pair) -> float | None:
        return HEIGHT / float(np.linalg.norm(CENTRES[pair[0]] - CENTRES[pair[1]])) if floor else None

    downs = np.stack([rotation.T @ (0.0, 1, 0) for rotation in ROTATIONS])
    return build_tour(features, relations, downs, 1e-3, floor_height)


@pytest.mark.parametrize("shared", [True, False])
def test_shared_points_or_the_floor_determine_distances(shared: bool) -> None:
    tour = _build(shared, floor=not shared)
    assert tour.placed == (0, 1, 2)
    sides = [np.linalg.norm(x[1] - x[0]) / np.linalg.norm(x[2] - x[1]) for x in (tour.poses[:, :3, 3], CENTRES)]
    assert sides[0] == pytest.approx(sides[1], rel=1e-2)


def test_a_panorama_without_shared_points_and_floor_is_left_out() -> None:
    tour = _build(False, floor=False)
    assert tour.placed == (0, 1)
    reason, other = tour.unplaced[2]
    assert "distance cannot be determined" in reason and other == 1


def test_a_pair_that_contradicts_two_better_ones_is_rejected() -> None:
    tour = _build(True, ((0, 1), (1, 2), (0, 2)), turn=math.radians(20))
    assert tour.rejected == ((0, 2),) and tour.placed == (0, 1, 2)
