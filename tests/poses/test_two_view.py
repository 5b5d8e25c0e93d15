"""The relative pose of two views is found among outliers, and what cannot be found is said."""

import math

import numpy as np
import pytest

from pansplat.poses.axes import NO_PRIOR, RotationPrior, SceneAxes
from pansplat.poses.features import Features, Matches
from pansplat.poses.solvers import angle_between, rotation_angle, rotation_exp
from pansplat.poses.two_view import RelativePose, estimate_relative_pose, polish_pose, polish_relative_pose

PIXEL = 2 * math.pi / 2048
NOISE = 0.3 * PIXEL


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the random samples, where the right pose must be found."""
    monkeypatch.setattr("pansplat.poses.two_view._TOP_SETS", (80, 2500))


def features(bearings, sizes: np.ndarray | float = 1.0) -> tuple[Features, Features]:
    """Features of both views with these bearings and no descriptors."""
    count = len(bearings.first)
    rest = np.zeros((count, 128), np.float32), np.broadcast_to(sizes, count), PIXEL
    return Features(bearings.first, *rest), Features(bearings.second, *rest)


def estimate(bearings, seed: int = 0, axes: RotationPrior = NO_PRIOR, **options) -> RelativePose:
    """The pose of bearings whose outliers come last, with ratios that hardly reveal them."""
    rng = np.random.default_rng(seed)
    ratio = np.sort(rng.uniform(0.6, 0.85, len(bearings.first)))
    order = rng.permutation(len(ratio))  # outliers are spread over all ratios
    return estimate_relative_pose(
        *features(bearings), Matches(np.stack((order, order), axis=1), ratio), axes, seed=seed, **options
    )


def errors_degrees(found: RelativePose, bearings) -> tuple[float, float]:
    turn = rotation_angle(found.rotation @ bearings.rotation.T)
    return math.degrees(turn), math.degrees(angle_between(found.translation, bearings.translation))


@pytest.mark.parametrize("outliers", [0.0, 0.7])
def test_the_pose_is_found_among_outliers_within_the_stated_uncertainty(scene, outliers, quick) -> None:
    bearings = scene(1, 300, noise=NOISE, outliers=outliers)
    found = estimate(bearings)
    rotation, direction = errors_degrees(found, bearings)
    assert found.is_reliable, found.problem
    assert rotation < min(0.1, 4 * math.degrees(found.uncertainty[0]))
    assert direction < min(0.2, 4 * math.degrees(found.uncertainty[1]))


def test_points_of_one_plane_determine_the_pose(scene, quick) -> None:
    bearings = scene(3, 300, noise=NOISE, outliers=0.4, planar=True, translation=np.array((0.6, 0.0, -0.8)))
    found = estimate(bearings)
    rotation, direction = errors_degrees(found, bearings)
    assert found.is_reliable, found.problem
    assert rotation < 0.3 and direction < 0.6


def test_a_translation_from_pole_to_pole_is_found(scene, quick) -> None:
    bearings = scene(4, 300, noise=NOISE, outliers=0.5, translation=np.array((0.0, 1.0, 0.0)))
    rotation, direction = errors_degrees(estimate(bearings), bearings)
    assert rotation < 0.1 and direction < 0.2


def test_a_pure_rotation_is_reported_as_one_place(scene, quick) -> None:
    bearings = scene(5, 300, noise=NOISE, outliers=0.5, translation=np.zeros(3), rotation=rotation_exp(np.ones(3)))
    found = estimate(bearings)
    assert not found.is_reliable and found.problem is not None and "one place" in found.problem
    assert math.degrees(rotation_angle(found.rotation @ bearings.rotation.T)) < 0.2


def test_views_turned_by_half_a_turn_about_the_baseline_are_distinguished(scene, quick) -> None:
    for turn in (0.0, math.pi):
        translation = np.array((1.0, 0.0, 0.0))
        bearings = scene(6, 250, noise=NOISE, rotation=rotation_exp(turn * translation), translation=translation)
        assert max(errors_degrees(estimate(bearings), bearings)) < 0.2


def test_random_matches_are_refused(scene) -> None:
    for seed in range(3):
        assert not estimate(scene(seed, 400, outliers=1.0)).is_reliable


def test_matches_of_one_object_are_refused(scene) -> None:
    bearings = scene(7, 300, noise=NOISE, outliers=0.7)
    near = bearings.first[:, 2] > 0.97
    first, second = bearings.first[near], bearings.second[near]
    found = estimate(type(bearings)(first, second, bearings.rotation, bearings.translation))
    assert not found.is_reliable


def test_walls_and_floor_confirm_a_pose_of_few_matches(scene) -> None:
    turn = np.array((0, math.pi / 2, 0))
    bearings = scene(
        10, 40, noise=NOISE, outliers=0.4, rotation=rotation_exp(turn), translation=np.array((0.8, 0.0, 0.6))
    )
    axes = SceneAxes(np.array(((0.0, 1, 0), (0, 0, 1), (1, 0, 0))), True, True)
    reliable = [
        estimate(bearings, axes=prior, agree_on_floor=lambda hypothesis, floor=floor: floor).is_reliable
        for prior, floor in ((NO_PRIOR, False), (NO_PRIOR, True), (RotationPrior(axes, axes), True))
    ]
    assert reliable == [False, False, True]


def test_the_floor_prefers_a_pose_among_equal_ones(scene, quick) -> None:
    both = [scene(seed, 60, noise=NOISE) for seed in (11, 12)]
    mixed = type(both[0])(
        *(np.concatenate([getattr(b, side) for b in both]) for side in ("first", "second")),
        both[0].rotation,
        both[0].translation,
    )
    for wanted in both:
        found = estimate(
            mixed, agree_on_floor=lambda h, wanted=wanted: bool(rotation_angle(h.rotation @ wanted.rotation.T) < 0.01)
        )
        assert rotation_angle(found.rotation @ wanted.rotation.T) < 0.01


def test_too_few_matches_are_refused(scene) -> None:
    found = estimate(scene(8, 6))
    assert not found.is_reliable and "only 6 features match" in str(found.problem)


def test_many_matches_of_one_distorted_object_do_not_outweigh_the_others(scene) -> None:
    for seed in range(3):
        bearings = scene(seed, 600, noise=NOISE)
        near = bearings.first[:, 2] > 0.9
        chosen = np.concatenate((np.flatnonzero(near), np.flatnonzero(~near)[:60]))
        a, b = bearings.first[chosen], bearings.second[chosen]
        b = np.where(near[chosen][:, None], b @ rotation_exp(np.array((2e-3, 0, 0))).T, b)  # the object is displaced
        start = rotation_exp(np.array((0, 5e-3, 0))) @ bearings.rotation, bearings.translation
        rotation, translation, deviations = polish_pose(a, b, *start, NOISE)
        assert rotation_angle(rotation @ bearings.rotation.T) < 4 * deviations[0] < 0.02
        assert angle_between(translation, bearings.translation) < 4 * deviations[1]


def test_further_matches_polish_a_pose(scene, quick) -> None:
    bearings = scene(9, 900, noise=2 * NOISE, outliers=0.5)
    few = type(bearings)(bearings.first[:60], bearings.second[:60], bearings.rotation, bearings.translation)
    found, count = estimate(few), len(bearings.first)
    every = Matches(np.tile(np.arange(count)[:, None], (1, 2)), np.full(count, 0.7))
    polished = polish_relative_pose(found, *features(bearings), every)
    assert len(polished.indices) > len(found.indices) and polished.uncertainty[0] < found.uncertainty[0]
    assert sum(errors_degrees(polished, bearings)) < sum(errors_degrees(found, bearings))


def _polish(bearings, ratio: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """Errors of a polished pose that was 0.5 degrees off."""
    start = rotation_exp(np.radians((0.3, -0.4, 0.0))) @ bearings.rotation
    indices = np.tile(np.arange(len(ratio))[:, None], (1, 2))
    relation = RelativePose(start, bearings.translation, indices[:8], 99.0, 99.0, 50.0, 0.5, (0.1, 0.1), None)
    return errors_degrees(polish_relative_pose(relation, *features(bearings, sizes), Matches(indices, ratio)), bearings)


def _displaced(bearings, others, turns: np.ndarray):
    """The bearings, then those of others that the second camera sees turned."""
    second = (3.0 * others.first) @ bearings.rotation.T + bearings.translation
    second = np.einsum("nij,nj->ni", turns, second / np.linalg.norm(second, axis=1, keepdims=True))
    joined = (np.concatenate(x) for x in ((bearings.first, others.first), (bearings.second, second)))
    return type(bearings)(*joined, bearings.rotation, bearings.translation)


def test_wrong_matches_near_the_epipolar_curves_hardly_move_a_pose(scene) -> None:
    turns = np.radians(np.random.default_rng(0).normal((0.3, -0.4, 0), 1.2, (400, 3)))  # about the wrong start
    mixed = _displaced(scene(13, 30, noise=NOISE), scene(40, 400), rotation_exp(turns))
    ratio = np.concatenate((np.full(30, 0.65), np.full(400, 0.93)))
    assert max(_polish(mixed, ratio, np.ones(430))) < 0.2


def test_large_features_have_a_small_weight(scene) -> None:
    turns = np.tile(rotation_exp(np.radians((0.2, 0.2, 0))), (120, 1, 1))
    mixed = _displaced(scene(15, 40, noise=NOISE), scene(16, 120), turns)
    errors = []
    for size in (1.0, 40.0):
        sizes = np.concatenate((np.ones(40), np.full(120, size)))
        errors.append(max(_polish(mixed, np.full(160, 0.6), sizes)))
    assert errors[1] < 0.5 * errors[0]
