"""Door leaves fill their holes when closed, and swing without touching the walls beside them."""

import numpy as np
import pytest

from pansplat_homes.doors import DoorStyle, Leaf, add_leaf, add_wall, extent_across, plan_leaves
from pansplat_homes.plans import INNER, HoleKind, Plan, sample_plan
from pansplat_homes.scene import SceneBuilder
from pansplat_homes.textures import Pattern


def _leaves() -> list[tuple[Plan, Leaf]]:
    rng, found = np.random.default_rng(1), []
    for _ in range(30):
        plan = sample_plan(rng)
        for wall, hole in plan.passages():
            if hole.kind == HoleKind.DOOR:
                found += [(plan, leaf) for leaf in plan_leaves(plan, wall, hole, rng)]
    return found


def _box(leaf: Leaf, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the leaf without its handle."""
    builder = SceneBuilder(np.random.default_rng(0))
    material = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5))
    add_leaf(builder, leaf, angle, DoorStyle(material, material, material, (0, 0), 0.0, False, material, 0.0))
    maps, half = builder.maps[0].reshape(3, 4), builder.halves[0]
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    return signs * half @ (maps[:, :3] * half[:, None]) + maps[:, 3], half


def test_closed_leaves_are_in_their_holes() -> None:
    for _, leaf in _leaves():
        corners, _ = _box(leaf, 0.0)
        along, across = (2, 0) if leaf.wall.axis == 0 else (0, 2)
        assert leaf.hole.start < corners[:, along].min() and corners[:, along].max() < leaf.hole.end
        assert np.abs(corners[:, across] - leaf.wall.at).max() <= INNER / 2 + 1e-9


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_open_leaves_stay_in_the_room_that_they_open_to(share: float) -> None:
    for plan, leaf in _leaves():
        corners, _ = _box(leaf, share * leaf.largest)
        x0, z0, x1, z1 = plan.interior(leaf.wall.rooms[1 if leaf.side > 0 else 0])
        reach = INNER + 1e-9  # the hinge is in the wall
        assert x0 - reach <= corners[:, 0].min() and corners[:, 0].max() <= x1 + reach
        assert z0 - reach <= corners[:, 2].min() and corners[:, 2].max() <= z1 + reach


def test_walls_block_all_but_their_holes() -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        plan = sample_plan(rng)
        for wall in plan.walls:
            builder = SceneBuilder(rng)
            add_wall(builder, plan, wall, 2.6)
            for along, up in rng.uniform((wall.start, 0), (wall.end, 2.6), size=(20, 2)):
                x, z = wall.point(along, sum(extent_across(wall)) / 2)
                point = np.array((x, -up, z))
                inside = any(
                    (np.abs(m.reshape(3, 4)[:, :3] @ (point - m.reshape(3, 4)[:, 3])) <= 1).all() for m in builder.maps
                )
                is_hole = any(h.start < along < h.end and h.low < up < h.top for h in wall.holes)
                assert inside != is_hole


def test_the_faces_of_closed_leaves_belong_to_the_rooms_that_they_face() -> None:
    """The tracer finds the room of a surface 2 cm in front of it."""
    for plan, leaf in _leaves():
        corners, _ = _box(leaf, 0.0)
        along, across = (2, 0) if leaf.wall.axis == 0 else (0, 2)
        middle = corners[:, along].mean()
        for sign, room, face in zip(
            (-1, 1), leaf.wall.rooms, (corners[:, across].min(), corners[:, across].max()), strict=True
        ):
            away = face + 0.02 * sign - leaf.wall.at
            assert abs(away) > 1e-3
            assert plan.room_at(*leaf.wall.point(middle, away)) == room
