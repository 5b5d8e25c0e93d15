"""The straight walls that panoramas show."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from synthetic_houses import (
    CAMERA_HEIGHT,
    CAMERAS,
    CEILING,
    HALL,
    L_ROOM,
    WALLS,
    make_plan,
    make_rooms,
    make_walls_scene,
    walls_around,
)

from pansplat.gaussians.scene import Gaussians


def _measure_angles(outline: np.ndarray) -> list[float]:
    """Angles at the corners, degrees."""
    before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.degrees(np.arctan2(cross, (before * after).sum(axis=1))).tolist()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_rooms_have_their_areas_angles_and_corners(noise: float) -> None:
    plan = make_plan(make_walls_scene(WALLS, CAMERAS, turn_degrees=17, noise=noise))
    assert [(room.panoramas, len(room.outline)) for room in plan.rooms] == [((0, 1), 6), ((2,), 4)]
    assert [room.shape.area for room in plan.rooms] == pytest.approx([24.0, 15.6], rel=0.02)
    turn = math.radians(17)
    axes = np.array(((math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))))
    for room, corners in zip(plan.rooms, (L_ROOM, HALL), strict=True):
        assert sorted(abs(angle) for angle in _measure_angles(room.outline)) == pytest.approx([90] * len(corners))
        distances = np.linalg.norm(room.outline[:, None] - np.array(corners) @ axes, axis=2).min(axis=0)
        assert distances.max() < 0.08
    assert plan.camera_height == pytest.approx(CAMERA_HEIGHT, rel=0.01)


def test_an_oblique_wall_stays_oblique() -> None:
    corners = [(0.0, 0.0), (5.0, 0.0), (5.0, 2.0), (3.0, 4.0), (0.0, 4.0)]
    (room,) = make_plan(make_walls_scene(walls_around(corners), [(2.0, 1.8)])).rooms
    assert room.shape.area == pytest.approx(18.0, rel=0.02)
    assert sorted(_measure_angles(room.outline)) == pytest.approx([45, 45, 90, 90, 90], abs=1)


def test_rooms_do_not_depend_on_how_many_gaussians_show_a_surface() -> None:
    """A row of books before a wall, which a third of each ray below the ceiling meets, has the most detail."""
    plain = make_rooms()
    means, labels = plain.gaussians.means, plain.gaussians.views
    place = torch.stack([plain.cam2world[k, :3, 3] for k in range(3)]).to(means)[labels.long()]
    offset = means - place
    height, angle = -offset[:, 1] / (CEILING - CAMERA_HEIGHT), torch.atan2(offset[:, 0], offset[:, 2])
    is_book = (height > 0.6) & (height < 0.68) & (angle.abs() < 0.6)
    moved = torch.where(is_book[:, None], place + 0.6 * offset, means)
    moved[is_book, 1] = means[is_book, 1]
    shelf = dataclasses.replace(plain, gaussians=dataclasses.replace(plain.gaussians, means=moved))
    books = shelf.gaussians.select(is_book)
    detailed = dataclasses.replace(shelf, gaussians=Gaussians.cat([shelf.gaussians, *[books] * 15]))
    few, many = make_plan(shelf), make_plan(detailed)
    assert [room.panoramas for room in few.rooms] == [room.panoramas for room in many.rooms] == [(0, 1), (2,)]
    for room, other in zip(few.rooms, many.rooms, strict=True):
        assert other.outline == pytest.approx(room.outline, abs=0.02)
