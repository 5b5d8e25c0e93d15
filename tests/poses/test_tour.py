"""Tours of synthetic cameras: placing by estimated distances or by shared points, groups, and contradictions."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pansplat.poses.features import Features
from pansplat.poses.solvers import make_motion, rotation_angle, rotation_exp
from pansplat.poses.tour import Group, IndexPair, Tour, build_tour, drop_contradictions
from pansplat.poses.two_view import Hypotheses, RelativePose

CENTRES = np.array(((0.0, 0, 0), (1.0, 0, 0.2), (1.4, 0, 1.5), (-0.8, 0, 1.1), (0.2, 0, 2.0)))  # camera heights
ROTATIONS = rotation_exp(np.array(((0, 0, 0), (0, 0.5, 0), (0, -0.8, 0), (0, 2.0, 0), (0, -1.4, 0))))
DOWN = np.stack([rotation.T @ (0.0, 1, 0) for rotation in ROTATIONS])
COUNT = 60  # points of a pair


def relate(pair: IndexPair, indices: np.ndarray) -> RelativePose:
    """The right relation of two cameras."""
    i, j = pair
    way = ROTATIONS[j].T @ (CENTRES[i] - CENTRES[j])
    distance = float(np.linalg.norm(way))
    return RelativePose(
        ROTATIONS[j].T @ ROTATIONS[i],
        way / distance,
        indices,
        score=300.0,
        places=50.0,
        uncertainty=(1e-3, 1e-3),
        distance=distance,
        log_odds=5.0,
    )


def change_last(relations: dict, turn: float = 0.0, stretch: float = 1.0, **changes) -> dict:
    """Relations of which the last one is turned by radians, stretched, and has other fields."""
    *_, (pair, last) = relations.items()
    rotation = rotation_exp(np.array((0, turn, 0))) @ last.rotation
    return relations | {pair: replace(last, rotation=rotation, distance=stretch * last.distance, **changes)}


def list_kept(**changes) -> list[IndexPair]:
    """What is kept of the pairs of three cameras, the best first, if the last one is changed."""
    pairs, none = ((0, 1), (1, 2), (0, 2)), np.empty((0, 2), np.int64)
    relations = {pair: replace(relate(pair, none), score=300.0 - n) for n, pair in enumerate(pairs)}
    return list(drop_contradictions(change_last(relations, **changes)))


def see(world: np.ndarray, views: int = len(CENTRES), misleading: int = 0) -> list[Features]:
    """What the first cameras see of points, and of the last ones with the third camera 20 % further from the second."""
    features, wrong = [], slice(len(world) - misleading, None)
    for view, (rotation, centre) in enumerate(zip(ROTATIONS[:views], CENTRES[:views], strict=True)):
        rays = (world - centre) @ rotation
        if view == 2:
            rays[wrong] = (world[wrong] - CENTRES[1] - 1.2 * (centre - CENTRES[1])) @ rotation
        rest = np.empty((len(world), 128), np.float32), np.zeros(len(world)), np.full(len(world), 1e-3)
        features.append(Features(rays / np.linalg.norm(rays, axis=1, keepdims=True), *rest))
    return features


def build(*pairs: IndexPair, shared: bool = False, views: int = 3, misleading: int = 0, **changes) -> Tour:
    """The tour by the given pairs, each with own points unless all cameras share them.

    Args:
        misleading: further points of all cameras, seen as if the third one were 20 % further from the second.
        changes: of the last pair's relation (`change_last`).
    """
    rng = np.random.default_rng(0)
    world = rng.uniform(-4, 4, ((COUNT if shared else COUNT * len(pairs)) + misleading, 3))
    wrong = np.arange(len(world) - misleading, len(world))
    relations = {}
    for n, pair in enumerate(pairs):
        own = np.append(np.arange(COUNT) + (0 if shared else COUNT * n), wrong)
        relations[pair] = replace(relate(pair, np.stack((own, own), axis=1)), score=300.0 - n)
    relations = change_last(relations, **changes)
    return build_tour(see(world, views, misleading), relations, DOWN[:views], 1e-3)


def sides(group: Group) -> list[float]:
    """Distances of consecutive cameras."""
    return np.linalg.norm(np.diff(group.poses[:, :3, 3], axis=0), axis=1).tolist()


TRUE_SIDES = np.linalg.norm(np.diff(CENTRES[:3], axis=0), axis=1)


@pytest.mark.parametrize("shared", [True, False])
def test_cameras_are_placed_in_camera_heights(shared: bool) -> None:
    (group,) = build((0, 1), (1, 2), shared=shared).groups
    assert group.placed == (0, 1, 2)
    assert sides(group) == pytest.approx(TRUE_SIDES.tolist(), rel=1e-2)
    for pose, rotation in zip(group.poses, ROTATIONS, strict=False):
        assert rotation_angle(group.poses[0, :3, :3].T @ pose[:3, :3] @ (ROTATIONS[0].T @ rotation).T) < 1e-3
    assert (group.depths > 0).all() and np.median(group.angles) < 1e-4


def test_a_panorama_without_shared_points_is_placed_at_its_estimated_distance() -> None:
    (group,) = build((0, 1), (1, 2), stretch=1.4).groups
    assert sides(group) == pytest.approx([TRUE_SIDES[0], 1.4 * TRUE_SIDES[1]], rel=1e-2)


def test_points_that_three_panoramas_see_correct_an_estimated_distance() -> None:
    (group,) = build((0, 1), (1, 2), shared=True, stretch=1.1).groups
    assert sides(group)[1] / sides(group)[0] == pytest.approx(TRUE_SIDES[1] / TRUE_SIDES[0], rel=1e-3)


def test_a_few_wrong_points_that_three_panoramas_see_do_not_change_estimated_distances() -> None:
    (group,) = build((0, 1), (1, 2), misleading=2).groups
    assert sides(group) == pytest.approx(TRUE_SIDES.tolist(), rel=0.01)


def test_groups_stay_apart_and_the_largest_comes_first() -> None:
    tour = build((0, 1), (2, 3), (3, 4), views=5)
    assert [group.placed for group in tour.groups] == [(2, 3, 4), (0, 1)]
    assert not tour.unplaced
    assert [len(group.poses) for group in tour.groups] == [3, 2]


def test_an_unreliable_pair_does_not_connect_groups() -> None:
    tour = build((0, 1), (2, 3), (1, 2), views=4, problem="too little in common", log_odds=0.2)
    assert [group.placed for group in tour.groups] == [(0, 1), (2, 3)]


def test_the_reason_against_a_panorama_says_what_to_do_and_has_the_figures_apart() -> None:
    tour = build((0, 1), (1, 2), views=4, problem="too little in common: 20 places match", log_odds=0.2)
    room = "no other photograph shows this room"
    assert tour.unplaced == {
        2: (f"{room} well enough: take one in the doorway", 1, "too little in common: 20 places match"),
        3: (f"{room}: take one in the doorway", None, ""),
    }
    tour = build((0, 1), (1, 2), views=3, problem="both were taken at one place: parallax of 0.02 degrees")
    assert tour.unplaced[2][0] == "another photograph was taken at this place: take one a metre away"


@pytest.mark.parametrize("changes", [{"turn": math.radians(20)}, {"stretch": 2.0}])
def test_a_pair_that_contradicts_two_better_ones_is_rejected(changes: dict[str, float]) -> None:
    for shared in (True, False):
        tour = build((0, 1), (1, 2), (0, 2), shared=shared, **changes)
        assert tour.groups[0].placed == (0, 1, 2)
        assert sides(tour.groups[0]) == pytest.approx(TRUE_SIDES.tolist(), rel=1e-2)
    assert list_kept(**changes) == [(0, 1), (1, 2)]
    assert len(list_kept(turn=math.radians(2), stretch=1.1)) == 3


def test_the_less_probable_pair_of_a_contradiction_is_rejected() -> None:
    # (0, 2) is the most probable pair; (1, 2) has a lower score than (0, 1), so that it is the one that is dropped.
    assert list_kept(stretch=2.0, log_odds=9.0) == [(0, 1), (0, 2)]


DOUBT = {"problem": "too little in common", "log_odds": -1.0}


@pytest.mark.parametrize(
    ("changes", "is_used"),
    [({}, True), ({"turn": math.radians(20)}, False), ({"stretch": 2.0}, False), ({"log_odds": -5.0}, False)],
)
def test_a_doubtful_pair_is_used_only_if_it_closes_a_triangle(changes: dict[str, float], is_used: bool) -> None:
    tour = build((0, 1), (1, 2), (0, 2), **(DOUBT | changes))
    assert set(tour.confirmed) == ({(0, 2)} if is_used else set()) and tour.groups[0].placed == (0, 1, 2)
    alone = build((0, 1), (1, 2), **(DOUBT | changes))
    assert not alone.confirmed and alone.groups[0].placed == (0, 1) and set(alone.unplaced) == {2}


def suggest(pair: IndexPair, *log_odds: float, turn: float = 0.0, problem: str | None = "too little in common"):
    """A relation without matches; the first of its hypotheses is the right pose, turned by an angle, radians."""
    right = relate(pair, np.empty((0, 2), np.int64))
    rotation = rotation_exp(np.array((0, turn, 0))) @ right.rotation
    count = len(log_odds)
    wrong = [rotation_exp(np.array((0, 1.0 + n + 0.5 * pair[0], 0))) @ right.rotation for n in range(count - 1)]
    distances = [right.distance] + [2 + n for n in range(count - 1)]
    translations = np.array(distances)[:, None] * right.translation
    hypotheses = Hypotheses(make_motion(np.stack([rotation, *wrong]), translations), np.array(log_odds))
    return replace(right, rotation=rotation, log_odds=max(log_odds), problem=problem, hypotheses=hypotheses)


def join(*suggested: tuple[IndexPair, RelativePose]) -> Tour:
    """The tour of two cameras with matches, and of others without."""
    world, own = np.random.default_rng(0).uniform(-4, 4, (COUNT, 3)), np.arange(COUNT)
    relations = {(0, 1): relate((0, 1), np.stack((own, own), axis=1))} | dict(suggested)
    return build_tour(see(world), relations, DOWN, 1e-3)


def is_right(group: Group) -> bool:
    """Whether all cameras are at their places, relative to the first one."""
    first = group.placed[0]
    centres = (CENTRES[list(group.placed)] - CENTRES[first]) @ ROTATIONS[first]
    found = (group.poses[:, :3, 3] - group.poses[0, :3, 3]) @ group.poses[0, :3, :3]
    return bool(np.abs(found - centres).max() < 0.02)


def test_hypotheses_of_two_pairs_that_agree_join_a_panorama_to_a_group() -> None:
    tour = join(((0, 2), suggest((0, 2), -0.3, -4.0)), ((1, 2), suggest((1, 2), -0.3, -4.0)))
    assert tour.groups[0].placed == (0, 1, 2) and is_right(tour.groups[0])


def test_a_probable_pose_without_matches_joins_a_panorama_or_two() -> None:
    tour = join(((1, 2), suggest((1, 2), 2.0, problem=None)), ((3, 4), suggest((3, 4), 2.0, problem=None)))
    assert [group.placed for group in tour.groups] == [(0, 1, 2), (3, 4)]
    assert all(is_right(group) for group in tour.groups)
    assert not len(tour.groups[1].depths)


def test_hypotheses_that_differ_or_are_alone_join_nothing() -> None:
    one, turned = suggest((0, 2), -0.3, -4.0), suggest((1, 2), -0.3, -4.0, turn=math.radians(20))
    for suggested in ([((0, 2), one), ((1, 2), turned)], [((0, 2), one)], [((1, 2), suggest((1, 2), 2.0, 2.0))]):
        assert join(*suggested).groups[0].placed == (0, 1)
