"""Plans fill their area without overlap, and every room can be reached."""

import itertools

import numpy as np
import pytest

from pansplat_homes.plans import OUTSIDE, Plan, RoomKind, sample_plan


@pytest.fixture(scope="module")
def plans() -> list[Plan]:
    return [sample_plan(np.random.default_rng((2, index))) for index in range(60)]


def test_rooms_do_not_overlap_and_are_all_connected(plans: list[Plan]) -> None:
    for plan in plans:
        for first, second in itertools.combinations([room.corners for room in plan.rooms], 2):
            wide = min(first[2], second[2]) - max(first[0], second[0])
            deep = min(first[3], second[3]) - max(first[1], second[1])
            assert wide < 1e-3 or deep < 1e-3
        assert min(plan.steps_from(0)) == 0


def test_walls_separate_the_rooms_that_they_name(plans: list[Plan]) -> None:
    for plan in plans:
        for wall in plan.walls:
            for sign, room in zip((-1, 1), wall.rooms, strict=True):
                assert plan.room_at(*wall.point((wall.start + wall.end) / 2, 0.01 * sign)) == room
            assert all(wall.start <= hole.start < hole.end <= wall.end for hole in wall.holes)
            assert wall.rooms != (OUTSIDE, OUTSIDE)


def test_walls_close_each_room(plans: list[Plan]) -> None:
    for plan in plans:
        for index, room in enumerate(plan.rooms):
            assert sum(wall.length for wall in plan.walls_of(index)) == pytest.approx(2 * (room.width + room.depth))


def test_plans_have_the_sizes_and_rooms_of_homes(plans: list[Plan]) -> None:
    counts = [len(plan.rooms) for plan in plans]
    assert min(counts) <= 2 and max(counts) >= 9
    kinds = {room.kind for plan in plans for room in plan.rooms}
    assert kinds == set(RoomKind)
    for plan in plans:
        x0, z0, x1, z1 = plan.bounds
        assert min(x1 - x0, z1 - z0) > 2.7 and max(x1 - x0, z1 - z0) <= 14
        for room in plan.rooms:
            assert min(room.width, room.depth) > (0.55 if room.parent >= 0 else 0.9)


def test_furniture_spans_avoid_holes_and_occupied_floor(plans: list[Plan]) -> None:
    for plan in plans[:20]:
        for index in range(len(plan.rooms)):
            for side in plan.sides(index):
                middle = (side.start + side.end) / 2
                taken = side.area(middle - 0.2, middle + 0.2, 0.5)
                for low, high in side.free_spans(2.0, 0.4, [taken]):
                    assert high <= middle - 0.2 + 1e-9 or low >= middle + 0.2 - 1e-9
                    assert all(hole.end <= low or hole.start >= high for hole in side.holes if hole.low < 2.0)


def test_closets_and_alcoves_have_a_passage_to_their_room(plans: list[Plan]) -> None:
    for plan in plans:
        links = {frozenset(wall.rooms) for wall, _ in plan.passages()}
        for room, parent in ((k, room.parent) for k, room in enumerate(plan.rooms) if room.parent >= 0):
            assert frozenset((room, parent)) in links
