"""Rooms: the outlines of several cameras joined and separated, and those whose walls do not close."""

import dataclasses

import numpy as np
import pytest
import shapely
from synthetic_houses import CAMERA_HEIGHT, CAMERAS, HALL, make_plan, make_rooms, make_walls_scene, walls_around

from pansplat.export.plan_files import describe_plan
from pansplat.tours import rooms
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import FloorOutline
from pansplat.tours.rooms import _enclose, _separate
from pansplat.tours.walls import Sight


def test_a_place_that_two_rooms_have_in_common_belongs_to_the_one_whose_camera_is_there() -> None:
    """The middle of the corridor is nearer to the camera of the other room."""
    places = np.empty((0, 2))
    sights = {k: Sight(np.array(center), places, places, places) for k, center in enumerate(((1.0, 0.5), (5.0, 1.5)))}
    shapes = [((0,), shapely.box(0, 0, 10, 1)), ((1,), shapely.box(0, 0, 10, 4))]
    first, second = (shape for _, shape in _separate(shapes, sights))
    assert first.equals(shapely.box(0, 0, 10, 1)) and second.equals(shapely.box(0, 1, 10, 4))


def test_each_camera_of_a_room_is_in_its_outline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another room takes the place of the second camera."""
    taken = shapely.box(-1, 4, 4, 7)
    monkeypatch.setattr(rooms, "_separate", lambda shapes, _: [(n, shape - taken) for n, shape in shapes])
    plan = make_plan(make_rooms())
    assert [room.panoramas for room in plan.rooms if room.is_closed] == [(0,), (2,)]
    assert any(line.endswith("walls do not close around panorama 2") for line in describe_plan(plan))


def test_a_room_whose_walls_do_not_close_is_a_rectangle_by_its_floor_beside_other_rooms() -> None:
    """The last camera sees half of the walls below the ceiling."""
    scene = make_rooms()
    means, is_last = scene.gaussians.means, scene.gaussians.views == 2
    is_hidden = is_last & (means[:, 1] < -0.2) & (means[:, 0] < 7.5)
    plan = make_plan(dataclasses.replace(scene, gaussians=scene.gaussians.select(~is_hidden)))
    assert [(room.panoramas, room.is_closed) for room in plan.rooms] == [((0, 1), True), ((2,), False)]
    shape = shapely.Polygon(plan.rooms[1].outline)
    assert shape.bounds == pytest.approx((5.0, 0.0, 9.0, 4.0), abs=0.2)
    assert shape.intersection(shapely.Polygon(plan.rooms[0].outline)).area < 0.01


def test_a_room_without_a_ceiling_ends_where_its_floor_does() -> None:
    scene = make_walls_scene(walls_around(HALL), CAMERAS[2:])
    open_room = scene.gaussians.select(scene.gaussians.means[:, 1] > -0.8)
    (room,) = make_plan(dataclasses.replace(scene, gaussians=open_room)).rooms
    assert room.shape.area == pytest.approx(15.6, rel=0.05)


def test_a_floor_without_walls_ends_where_most_of_it_does() -> None:
    """A tenth of the horizon looks through a window to each side, where the floor seems to go on."""
    azimuths = (np.arange(360) + 0.5) * np.pi / 180
    rays = np.stack((np.sin(azimuths), np.cos(azimuths)), axis=1)
    ends = 2.0 / np.abs(rays).max(axis=1)
    beyond = np.abs((azimuths + np.pi / 4) % (np.pi / 2) - np.pi / 4) < np.pi / 10
    corners = rays * np.where(beyond, 6.0, ends)[:, None] + np.array((7.0, 2.0))
    floor, surfaces = FloorOutline(corners, CAMERA_HEIGHT), TourFacts(make_rooms()).surfaces[2]
    shape = _enclose(surfaces, floor, np.eye(2), shapely.Polygon(), CAMERA_HEIGHT)
    assert shape.bounds == pytest.approx((5.0, 0.0, 9.0, 4.0), abs=0.1)
