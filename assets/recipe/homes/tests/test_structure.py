"""Stairs are walkable, and ceilings are closed around their wells."""

import numpy as np

from pansplat_homes.plans import Hole, HoleKind, Plan, Room, RoomKind, Wall
from pansplat_homes.scene import GeneratedScene, SceneBuilder
from pansplat_homes.structure import add_ceiling, add_slopes, add_stairs, plan_stairs
from pansplat_homes.textures import Pattern

HEIGHT = 2.6


def _plan() -> Plan:
    """A room of 6 x 4 metres with a door in one wall."""
    walls = [
        Wall(axis, at, 0.0, 4.0 if axis == 0 else 6.0, rooms)
        for axis, at, rooms in ((0, 0.0, (-1, 0)), (0, 6.0, (0, -1)), (2, 0.0, (-1, 0)), (2, 4.0, (0, -1)))
    ]
    walls[0].holes.append(Hole(1.5, 2.4, 0.0, 2.0, HoleKind.ENTRANCE))
    return Plan((Room((0, 0, 6, 4), RoomKind.LIVING),), tuple(walls))


def _finish(builder: SceneBuilder, material: int) -> GeneratedScene:
    builder.add_room((0, 0, 6, 4), [material] * 5, 0, 0, HEIGHT)
    return builder.finish((1, 1, 1), material, material)


def test_stairs_have_headroom_up_to_the_upper_floor() -> None:
    builder, plan = SceneBuilder(np.random.default_rng(0)), _plan()
    material = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5))
    found = plan_stairs(plan, 0, HEIGHT, [], builder.rng)
    assert found is not None
    side, lower, upper, width, well = found
    add_ceiling(builder, plan, 0, HEIGHT, HEIGHT + 0.1, well)
    add_stairs(builder, side, lower, upper, width, HEIGHT, (material, material))
    scene = _finish(builder, material)
    for share in np.linspace(0.02, 0.96, 20):
        x, z = side.point(lower + share * (upper - lower), 0.45 * width)
        heads = np.array([(x, -share * HEIGHT - 0.25 - up, z) for up in (0.1, 0.8, 1.5)])
        assert scene.clearance(heads).min() > 0.03
    under = np.array([(*side.point(lower + 0.5 * (upper - lower), 0.45 * width),)])
    assert scene.clearance(np.array([(under[0, 0], -0.3, under[0, 1])]))[0] == 0


def test_a_slope_joins_the_wall_at_the_knee_and_the_ceiling() -> None:
    builder, plan = SceneBuilder(np.random.default_rng(0)), _plan()
    material = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5))
    add_slopes(builder, plan, 0, HEIGHT, 0, 1.4)
    scene = _finish(builder, material)
    assert len(builder.maps) == 1  # the other side has a door
    (just_below, above) = (scene.clearance(np.array([(6.0, -up, 2.0)]))[0] for up in (1.38, 1.44))
    assert 0 < just_below < 0.03 and above == 0
    reach = HEIGHT - 1.4
    assert scene.clearance(np.array([(6.0 - reach, -HEIGHT - 0.02, 2.0)]))[0] < 0.01
    assert scene.clearance(np.array([(6.0 - reach - 0.1, -HEIGHT + 0.3, 2.0)]))[0] > 0.1


def test_a_stair_well_is_closed_around_and_above() -> None:
    builder, plan = SceneBuilder(np.random.default_rng(0)), _plan()
    material = builder.add_material(Pattern.PLAIN, (0.5, 0.5, 0.5))
    x0, z0, x1, z1 = well = (1.0, 0.0, 3.0, 0.9)  # beside an outer wall, above which there is no ceiling
    add_ceiling(builder, plan, 0, HEIGHT, HEIGHT + 0.1, well)
    scene = _finish(builder, material)
    x, z = (x0 + x1) / 2, (z0 + z1) / 2
    for up in np.arange(HEIGHT + 0.03, HEIGHT + 2.5, 0.1):
        around = np.array([(x0 - 0.03, -up, z), (x1 + 0.03, -up, z), (x, -up, z0 - 0.03), (x, -up, z1 + 0.03)])
        assert (scene.clearance(around) == 0).all()
        assert scene.clearance(np.array([(x, -up, z)]))[0] > 0.05
    assert scene.clearance(np.array([(x, -HEIGHT - 2.6, z)]))[0] == 0
