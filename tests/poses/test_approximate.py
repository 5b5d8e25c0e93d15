"""Approximate places: rooms whose links agree are found from known ones outwards; what is not probable has no place."""

from pathlib import Path

import pytest

from pansplat.poses import approximate
from pansplat.poses.approximate import place_linked
from pansplat.poses.placing import Guess, PlanPose

ROOMS = HALL, BATH, BED, LOFT = tuple(map(Path, ("hall", "bath", "bed", "loft")))
PLACES = {HALL: PlanPose(1, 2, 0.5), BATH: PlanPose(4, 2, -2), BED: PlanPose(4, 5, 3), LOFT: PlanPose(0, 9, 1)}


def _step(first: Path, second: Path) -> PlanPose:
    return PLACES[first].inverse().add(PLACES[second])


def _place(monkeypatch, guesses: dict[tuple[Path, Path], list[Guess]], known: tuple[Path, ...], links=None) -> dict:
    """The places if the pieces of two rooms state these guesses; both are linked unless `links` are given."""
    both = {room: {other: 0.0 for pair in guesses if room in pair for other in pair if other != room} for room in ROOMS}
    monkeypatch.setattr(approximate, "list_through_door", lambda pieces, links: guesses[pieces])
    return place_linked(
        {room: room for room in ROOMS}, links or both, [{room: PLACES[room] for room in known}] if known else []
    )


def test_rooms_are_found_one_behind_the_other_from_known_ones(monkeypatch) -> None:
    guesses = {(HALL, BED): [Guess(_step(HALL, BED), 0.9)], (BED, LOFT): [Guess(_step(BED, LOFT), 0.8)]}
    found = _place(monkeypatch, guesses, (HALL,))
    assert list(found) == [BED, LOFT] and [place.by for place in found.values()] == [(HALL,), (BED,)]
    for room, place in found.items():
        assert place.beside == HALL
        assert PLACES[HALL].add(place.place).distance(PLACES[room]) < 1e-9
        assert place.place.turn_between(_step(HALL, room)) < 1e-9


def test_a_chain_of_doubts_and_a_link_in_one_direction_state_no_place_on_the_plan_of_known_rooms(monkeypatch) -> None:
    guesses = {(HALL, BED): [Guess(_step(HALL, BED), 0.6)], (BED, LOFT): [Guess(_step(BED, LOFT), 0.6)]}
    assert list(_place(monkeypatch, guesses, (HALL,))) == [BED]
    assert _place(monkeypatch, guesses, (HALL,), {HALL: {BED: 0.0}}) == {}


def test_two_rooms_that_agree_outvote_a_wrong_wall_and_their_mean_is_the_place(monkeypatch) -> None:
    wrong, beside = PlanPose(-3, 0, 0), PlanPose(0.2, 0, 0)
    guesses = {
        (HALL, BED): [Guess(wrong, 0.5), Guess(_step(HALL, BED), 0.4)],
        (BATH, BED): [Guess(_step(BATH, BED).add(beside), 0.8)],
    }
    (place,) = _place(monkeypatch, guesses, (HALL, BATH)).values()
    assert place.by == (HALL, BATH) and place.place.turn_between(_step(HALL, BED)) < 1e-9
    assert PLACES[HALL].add(place.place).distance(PLACES[BED].add(beside)) == pytest.approx(0.2 * 0.4 / 1.2)


def test_without_a_pose_rooms_are_beside_the_one_with_most_links(monkeypatch) -> None:
    guesses = {(BATH, BED): [Guess(_step(BATH, BED), 0.9)], (BED, LOFT): [Guess(_step(BED, LOFT), 0.9)]}
    found = _place(monkeypatch, guesses, ())
    assert {room: place.beside for room, place in found.items()} == {BATH: BED, LOFT: BED}
    assert found[BATH].place.distance(_step(BED, BATH)) < 1e-9
