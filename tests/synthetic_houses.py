"""Scenes of cameras between straight walls, without images."""

import functools
import math
from collections.abc import Sequence

import numpy as np
import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.scene import Scene, SceneTour
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.tours.facts import TourFacts
from pansplat.tours.plan import Plan

CEILING, DOOR_TOP, CAMERA_HEIGHT = 2.6, 2.0, 1.5

Wall = tuple[tuple[float, float], tuple[float, float], float]
"""Ends (right, forward) of a wall and the height of its lower edge over the floor, or minus that of its upper one."""


def walls_around(corners: Sequence[tuple[float, float]], doors: Sequence[Wall] = ()) -> list[Wall]:
    """The walls of a room, with openings below the lower edges of doors, whose ends are on one of them in its order."""
    walls: list[Wall] = []
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        direction, rest = np.subtract(end, start), start
        for door in doors:
            offsets = [np.subtract(point, start) for point in door[:2]]
            if all(abs(direction[0] * offset[1] - direction[1] * offset[0]) < 1e-9 for offset in offsets):
                walls += [(rest, door[0], 0.0), door]
                rest = door[1]
        walls.append((rest, end, 0.0))
    return walls


def make_walls_scene(
    walls: Sequence[Wall],
    cameras: Sequence[tuple[float, float]],
    *,
    turn_degrees: float = 0.0,
    floors: Sequence[float] = (),
    noise: float = 0.0,
    shifts: Sequence[tuple[float, float]] = (),
    names: Sequence[str] = (),
    count: int = 20000,
) -> Scene:
    """The scene of cameras between walls.

    Args:
        walls: of all rooms of all storeys.
        cameras: places, metres.
        turn_degrees: of the house relative to the cameras.
        floors: heights of the floors of the cameras, metres.
        noise: relative standard deviation of a distance.
        shifts: of what each camera shows, metres.
        names: of the panoramas.
        count: Gaussians of each camera.
    """
    generator = np.random.default_rng(0)
    angle = math.radians(turn_degrees)
    turn = np.array(((math.cos(angle), -math.sin(angle)), (math.sin(angle), math.cos(angle))))
    ends = np.array([(start, end) for start, end, _ in walls]) @ turn.T
    lower = np.array([edge for *_, edge in walls])
    rays = fibonacci_directions(count).double().numpy() + 1e-9  # right, down, forward
    flat = rays[:, (0, 2)]
    means, views, poses = [], [], []
    for number, place in enumerate(np.array(cameras) @ turn.T):
        along, offset = ends[:, 1] - ends[:, 0], ends[:, 0] - place
        cross = flat[:, None, 0] * along[:, 1] - flat[:, None, 1] * along[:, 0]
        distance = (offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]) / cross
        position = (offset[:, 0] * flat[:, None, 1] - offset[:, 1] * flat[:, None, 0]) / cross
        height = CAMERA_HEIGHT - distance * rays[:, 1:2]
        is_met = (
            (distance > 0) & (position >= 0) & (position <= 1) & np.where(lower < 0, height <= -lower, height >= lower)
        )
        to_wall = np.where(is_met, distance, 30.0).min(axis=1)
        to_plane = np.where(rays[:, 1] > 0, CAMERA_HEIGHT, CAMERA_HEIGHT - CEILING) / rays[:, 1]
        reached = np.minimum(to_wall, to_plane) * (1 + noise * generator.standard_normal(count))
        center = np.array((place[0], -(floors[number] if floors else 0.0), place[1]))
        shift = np.array(shifts[number]) @ turn.T if shifts else np.zeros(2)
        means.append(center + reached[:, None] * rays + (shift[0], 0, shift[1]))
        views.append(np.full(count, number))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.from_numpy(center)
        poses.append(pose)
    labels = torch.from_numpy(np.concatenate(views))
    gaussians = make_balls(torch.from_numpy(np.concatenate(means)), 0.02, 1.0, views=labels)
    edges = tuple((k, k + 1, 0.5) for k in range(len(cameras) - 1)) if len(cameras) > 1 else ((0, 0, 1.0),)
    return Scene(gaussians, torch.stack(poses), 0.45, 10.0, names=tuple(names), tour=SceneTour(edges))


L_ROOM = [(0.0, 0.0), (5.0, 0.0), (5.0, 3.0), (3.0, 3.0), (3.0, 6.0), (0.0, 6.0)]  # 24 square metres
HALL = [(5.1, 0.0), (9.0, 0.0), (9.0, 4.0), (5.1, 4.0)]  # 15.6
DOOR: tuple[Wall, Wall] = (((5.0, 1.0), (5.0, 1.9), DOOR_TOP), ((5.1, 1.9), (5.1, 1.0), DOOR_TOP))
WALLS = [*walls_around(L_ROOM, DOOR[:1]), *walls_around(HALL, DOOR[1:])]
CAMERAS = [(1.5, 1.5), (1.2, 4.5), (7.0, 2.0)]


@functools.cache
def make_rooms() -> Scene:
    return make_walls_scene(WALLS, CAMERAS)


def make_plan(scene: Scene) -> Plan:
    return TourFacts(scene).plan
