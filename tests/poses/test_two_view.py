"""The relative pose of two views is found among outliers, and what cannot be found is said."""

import math

import numpy as np
import pytest

from pansplat.poses.axes import NO_PRIOR, RotationPrior, SceneAxes
from pansplat.poses.dense import Surroundings
from pansplat.poses.features import Features, Matches
from pansplat.poses.solvers import angle_between, rotation_angle, rotation_exp, skew
from pansplat.poses.two_view import (
    NO_LINKS,
    LinkDirections,
    RelativePose,
    _density,
    _Evidence,
    _score_essentials,
    estimate_relative_pose,
    polish_pose,
    polish_relative_pose,
)

PIXEL = 2 * math.pi / 2048
NOISE, STATED_NOISE = 0.3 * PIXEL, 0.45 * PIXEL


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the random samples, where the right pose must be found."""
    monkeypatch.setattr("pansplat.poses.two_view._TOP_SETS", (80, 2500))


def features(bearings, sizes: np.ndarray | float = 1.0) -> tuple[Features, Features]:
    """Features of both views with these bearings and no descriptors."""
    count = len(bearings.first)
    rest = np.zeros((count, 128), np.float32), np.broadcast_to(sizes, count), np.full(count, STATED_NOISE)
    return Features(bearings.first, *rest), Features(bearings.second, *rest)


def estimate(bearings, seed: int = 0, axes: RotationPrior = NO_PRIOR, **options) -> RelativePose:
    """The pose of bearings whose outliers come last, with priors that hardly reveal them."""
    rng = np.random.default_rng(seed)
    prior = -np.sort(-rng.uniform(0.06, 0.67, len(bearings.first)))
    order = rng.permutation(len(prior))  # outliers are spread over all priors
    return estimate_relative_pose(
        *features(bearings), Matches(np.stack((order, order), axis=1), prior), axes, seed=seed, **options
    )


def errors_degrees(found: RelativePose, bearings) -> tuple[float, float]:
    turn = rotation_angle(found.rotation @ bearings.rotation.T)
    return math.degrees(turn), math.degrees(angle_between(found.translation, bearings.translation))


HEIGHT = 1.35  # of the cameras over the floor of the room, metres
WALLS = SceneAxes(np.array(((0.0, 1, 0), (0, 0, 1), (1, 0, 0))), True, True)
PARALLEL = RotationPrior(WALLS, WALLS)
CENTRES = np.array((-0.9, 0, 0.4)), np.array((0.8, 0, -0.5))
TURN = rotation_exp(np.array((0, math.pi / 2, 0)))
HALF_TURN = np.diag((-1.0, 1, -1))
X = np.array((1.0, 0.0, 0.0))
MOTIONS = {
    "no outliers": {"outliers": 0.0},
    "70 % outliers": {"outliers": 0.7},
    "one plane": {"seed": 3, "outliers": 0.4, "planar": True, "translation": np.array((0.6, 0.0, -0.8))},
    "pole to pole": {"translation": np.array((0.0, 1.0, 0.0))},
    "along x": {"rotation": np.eye(3), "translation": X},
    "half a turn about the baseline": {"rotation": rotation_exp(math.pi * X), "translation": X},
    **{
        f"stairs of {rise} m": {"rotation": TURN.T, "translation": TURN.T @ np.array((1.6, rise, -0.9))}
        for rise in (0.5, 1.45, 2.9)
    },
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_pose_is_found_among_outliers_within_the_stated_uncertainty(motion: str, scene, quick) -> None:
    bearings = scene(**{"seed": 1, "count": 300, "noise": NOISE, "outliers": 0.5, **MOTIONS[motion]})
    found = estimate(bearings, axes=PARALLEL if motion.startswith("stairs") else NO_PRIOR)
    rotation, direction = errors_degrees(found, bearings)
    assert found.is_reliable, found.problem
    limits = (0.3, 0.6) if motion == "one plane" else (0.1, 0.2)
    assert rotation < min(limits[0], 4 * math.degrees(found.uncertainty[0]))
    assert direction < min(limits[1], 4 * math.degrees(found.uncertainty[1]))


def test_a_pure_rotation_is_reported_as_one_place(scene, quick) -> None:
    bearings = scene(5, 300, noise=NOISE, outliers=0.5, translation=np.zeros(3), rotation=rotation_exp(np.ones(3)))
    found = estimate(bearings)
    assert not found.is_reliable and found.problem is not None and "one place" in found.problem
    assert math.degrees(rotation_angle(found.rotation @ bearings.rotation.T)) < 0.2


def test_random_matches_are_refused(scene) -> None:
    for seed in range(3):
        assert not estimate(scene(seed, 400, outliers=1.0)).is_reliable


def test_matches_of_one_object_are_refused(scene) -> None:
    bearings = scene(7, 300, noise=NOISE, outliers=0.7)
    near = bearings.first[:, 2] > 0.97
    first, second = bearings.first[near], bearings.second[near]
    found = estimate(type(bearings)(first, second, bearings.rotation, bearings.translation))
    assert not found.is_reliable


@pytest.fixture
def see_room(scene, find_walls):
    """A function that makes bearings of a room's walls from its first place, and from a pose in it."""

    def see(seed: int, count: int, rotation: np.ndarray, centre: np.ndarray):
        example = scene(seed, count)
        points = CENTRES[0] + example.first * find_walls(example.first, CENTRES[0])[:, None]
        second = (points - centre) @ rotation
        second /= np.linalg.norm(second, axis=1, keepdims=True)
        rng = np.random.default_rng(seed)
        first, second = (b + NOISE * rng.normal(size=b.shape) for b in (example.first, second))
        first, second = (b / np.linalg.norm(b, axis=1, keepdims=True) for b in (first, second))
        return type(example)(first, second, rotation.T, rotation.T @ (CENTRES[0] - centre) / HEIGHT)

    return see


def join(*parts):
    """All matches of several ones, with the pose of the first ones."""
    both = (np.concatenate([getattr(part, side) for part in parts]) for side in ("first", "second"))
    return type(parts[0])(*both, parts[0].rotation, parts[0].translation)


def look(look_around, rotation: np.ndarray, centre: np.ndarray, room: int = 0) -> tuple[Surroundings, Surroundings]:
    """What cameras at the first place of a room, and at a pose in a room, see."""
    return look_around(0, np.eye(3), CENTRES[0]), look_around(room, rotation, centre)


def test_surroundings_confirm_a_pose_of_few_matches(scene, see_room, look_around) -> None:
    bearings = see_room(10, 20, TURN, CENTRES[1])
    mixed = join(bearings, scene(3, 20, outliers=1.0))
    alone = estimate(mixed, axes=PARALLEL)
    assert not alone.is_reliable and alone.log_odds == -math.inf and math.isnan(alone.distance)
    found = estimate(mixed, axes=PARALLEL, surroundings=look(look_around, TURN, CENTRES[1]))
    assert found.is_certain and math.isfinite(found.log_odds), found.problem
    assert max(errors_degrees(found, bearings)) < 0.5
    assert found.distance == pytest.approx(np.linalg.norm(bearings.translation), rel=0.03)
    other = estimate(mixed, axes=PARALLEL, surroundings=look(look_around, TURN, CENTRES[1], room=1))
    assert not other.is_reliable and str(other.problem).endswith("and the best pose is too uncertain to use")


def test_many_places_suffice_without_a_comparison(scene, quick) -> None:
    found = estimate(scene(1, 300, noise=NOISE))
    assert found.is_certain and found.log_odds == math.inf and found.places > 32


def test_a_pose_without_a_distance_is_refused_though_its_matches_suffice(see_room, look_around, quick, monkeypatch):
    monkeypatch.setattr("pansplat.poses.depth._DISTANCES", (math.log(100), math.log(200)))
    found = estimate(see_room(10, 300, TURN, CENTRES[1]), surroundings=look(look_around, TURN, CENTRES[1]))
    assert found.places > 32 and math.isnan(found.distance)
    assert found.problem == "the distance of the cameras cannot be determined"


def test_surroundings_choose_among_poses_of_equal_matches(see_room, look_around, quick) -> None:
    """The room has the same depth after half a turn; only what it shows differs."""
    poses = (TURN, CENTRES[1]), (HALF_TURN @ TURN, HALF_TURN @ CENTRES[1])
    parts = [see_room(11 + n, 40, *pose) for n, pose in enumerate(poses)]
    for wanted, pose in zip(parts, poses, strict=True):
        found = estimate(join(*parts), axes=PARALLEL, surroundings=look(look_around, *pose))
        assert max(errors_degrees(found, wanted)) < 0.5


@pytest.mark.parametrize("rise", [0.5, 0.9, -0.5])
def test_depths_in_other_units_do_not_outweigh_matches_that_suffice(scene, see_room, look_around, rise, quick) -> None:
    """Each camera's depth is in its own height over the floor, so that no surface agrees if these differ."""
    centre = CENTRES[1] - (0, rise, 0)
    bearings = see_room(10, 120, TURN, centre)
    mixed = join(bearings, scene(3, 120, outliers=1.0))
    found = estimate(mixed, axes=PARALLEL, surroundings=look(look_around, TURN, centre))
    assert found.is_certain and max(errors_degrees(found, bearings)) < 0.3, found.problem


def find_links(bearings) -> LinkDirections:
    """The right links of a pose."""
    there, back = -bearings.rotation.T @ bearings.translation, bearings.translation
    return LinkDirections(*(math.atan2(direction[0], direction[2]) for direction in (there, back)))


def test_ways_choose_among_poses_of_equal_matches(see_room, look_around, quick) -> None:
    poses = (TURN, CENTRES[1]), (HALF_TURN @ TURN, HALF_TURN @ CENTRES[1])
    parts = [see_room(11 + n, 40, *pose) for n, pose in enumerate(poses)]
    blank = [Surroundings(np.full((64, 128, 3), 0.5), view.depth) for view in look(look_around, *poses[0])]
    both, single = find_links(parts[0]), find_links(parts[1])
    for wanted, links in ((0, both), (1, LinkDirections(there=single.there)), (1, LinkDirections(back=single.back))):
        found = estimate(join(*parts), axes=PARALLEL, surroundings=tuple(blank), links=links)
        assert max(errors_degrees(found, parts[wanted])) < 0.5


def test_ways_state_the_direction_to_the_other_camera() -> None:
    rotation, translation = TURN.T, TURN.T @ (CENTRES[0] - CENTRES[1])
    towards = CENTRES[1] - CENTRES[0]
    yaw = math.atan2(towards[0], towards[2])
    for wrong, sign in ((0.0, 1), (0.2, 1), (2.0, -1), (math.pi, -1)):
        for turn in (wrong, wrong + 2 * math.pi, wrong - 2 * math.pi):
            assert sign * LinkDirections(there=yaw + turn).score(rotation[None], translation[None])[0] > 1
    assert NO_LINKS.score(rotation[None], translation[None]).tolist() == [0]


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
    every = Matches(np.tile(np.arange(count)[:, None], (1, 2)), np.full(count, 0.45))
    polished = polish_relative_pose(found, *features(bearings), every)
    assert len(polished.indices) > len(found.indices) and polished.uncertainty[0] < found.uncertainty[0]
    assert sum(errors_degrees(polished, bearings)) < sum(errors_degrees(found, bearings))


def _polish(bearings, prior: np.ndarray, sizes: np.ndarray) -> tuple[float, float]:
    """Errors of a polished pose that was 0.5 degrees off."""
    start = rotation_exp(np.radians((0.3, -0.4, 0.0))) @ bearings.rotation
    indices = np.tile(np.arange(len(prior))[:, None], (1, 2))
    figures = {"score": 99.0, "places": 50.0, "uncertainty": (0.1, 0.1)}
    relation = RelativePose(start, bearings.translation, indices[:8], distance=2.0, log_odds=9.0, **figures)
    polished = polish_relative_pose(relation, *features(bearings, sizes), Matches(indices, prior))
    assert (polished.distance, polished.log_odds) == (2.0, 9.0)
    return errors_degrees(polished, bearings)


def _displaced(bearings, others, turns: np.ndarray):
    """The bearings, then those of others that the second camera sees turned."""
    second = (3.0 * others.first) @ bearings.rotation.T + bearings.translation
    second = np.einsum("nij,nj->ni", turns, second / np.linalg.norm(second, axis=1, keepdims=True))
    joined = (np.concatenate(x) for x in ((bearings.first, others.first), (bearings.second, second)))
    return type(bearings)(*joined, bearings.rotation, bearings.translation)


def test_wrong_matches_near_the_epipolar_curves_hardly_move_a_pose(scene) -> None:
    turns = np.radians(np.random.default_rng(0).normal((0.3, -0.4, 0), 1.2, (400, 3)))  # about the wrong start
    mixed = _displaced(scene(13, 30, noise=NOISE), scene(40, 400), rotation_exp(turns))
    prior = np.concatenate((np.full(30, 0.6), np.full(400, 0.015)))
    assert max(_polish(mixed, prior, np.ones(430))) < 0.2


def test_large_features_have_a_small_weight(scene) -> None:
    turns = np.tile(rotation_exp(np.radians((0.2, 0.2, 0))), (120, 1, 1))
    mixed = _displaced(scene(15, 40, noise=NOISE), scene(16, 120), turns)
    errors = []
    for size in (1.0, 40.0):
        sizes = np.concatenate((np.ones(40), np.full(120, size)))
        errors.append(max(_polish(mixed, np.full(160, 0.67), sizes)))
    assert errors[1] < 0.5 * errors[0]


def test_essential_matrices_have_the_scores_of_the_plain_form(scene) -> None:
    bearings, rng = scene(4, 900, noise=NOISE, outliers=0.3), np.random.default_rng(0)
    a, b, prior, noise = bearings.first, bearings.second, rng.uniform(0.01, 0.8, 900), rng.uniform(1e-3, 3e-3, 900)
    rotations = rotation_exp(3e-3 * rng.normal(size=(20, 3))) @ bearings.rotation
    essentials = skew(bearings.translation) @ rotations
    ea, eb = a @ essentials.transpose(0, 2, 1), b @ essentials
    angle = np.abs((ea * b).sum(axis=2)) / np.sqrt((ea**2).sum(axis=2) + (eb**2).sum(axis=2))
    likelihood = np.where(angle < 12 * noise, _density(angle, noise), 0.0)
    expected = np.log(1 - prior + prior * likelihood).sum(axis=1)
    found = _score_essentials(essentials, _Evidence(a, b, prior, noise, NO_PRIOR))
    # The scores are summed in float32; their spread shows that the tolerance is small.
    assert found == pytest.approx(expected, abs=0.1) and np.ptp(expected) > 100
