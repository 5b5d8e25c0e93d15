"""Hotspots are on the floor, under their panoramas or where links lead, and are found by a click."""

from dataclasses import replace

import numpy as np
import pytest

from pansplat.inputs.panorama_sets import Link
from pansplat.tours.outlook import BINS
from pansplat_viewer.core.camera import Camera
from pansplat_viewer.core.hotspots import Hotspot, find_clicked, find_hotspots
from pansplat_viewer.core.tour_scenes import TourScenes


def find_spots(scenes: TourScenes, camera: Camera, *arguments) -> list[Hotspot]:
    return find_hotspots(scenes.tour, scenes.find_place(np.array(camera.position)), camera, *arguments)


def find_rings(*arguments) -> list[Hotspot]:
    return [spot for spot in find_spots(*arguments) if not spot.is_arrow]


def test_the_hotspot_of_a_link_is_where_it_meets_the_floor_or_a_wall(parted_house, load_house):
    scenes = TourScenes(parted_house)
    scenes.add(load_house(scenes.make_entry((1, 2))))
    scenes.move(parted_house.positions[2])
    camera = Camera(position=(0.0, 0.0, 1.6), vertical_fov_degrees=120.0)
    (hotspot,) = find_rings(scenes, camera, (200, 200))
    assert (hotspot.node, hotspot.label, hotspot.is_zoom) == (3, "to the hall", True)
    focal = 100 / np.tan(np.radians(60))
    assert hotspot.center == pytest.approx((100 + focal * np.tan(0.1), 100 + focal * np.tan(0.6) / np.cos(0.1)))
    scenes.move(parted_house.positions[3])
    panoramas = list(parted_house.panoramas)
    panoramas[3] = replace(panoramas[3], links=(Link("room2", 0.0, -0.2),))  # on a wall
    scenes.tour = replace(parted_house, panoramas=tuple(panoramas))
    (hotspot,) = find_rings(scenes, replace(camera, position=(20.0, 0.0, 1.6)), (200, 200))
    assert hotspot.center == pytest.approx((100, 100 + focal * np.tan(-0.2))) and hotspot.label == "room2"
    width, height = np.ptp(hotspot.ring, axis=0)
    assert height == pytest.approx(width, rel=0.01), "it is upright"
    scenes.outlooks[3] = np.full(BINS, 0.6)
    (hotspot,) = find_rings(scenes, replace(camera, position=(20.0, 0.0, 1.6)), (1280, 720))
    assert np.ptp(hotspot.ring, axis=0)[0] == pytest.approx(128, abs=1) and hotspot.radius == 64, "no ring is larger"


def test_a_hotspot_is_below_its_panorama_and_a_click_finds_the_nearest(house, load_house):
    scenes = TourScenes(house)
    scenes.add(load_house(scenes.make_entry((0, 1))))
    camera, focal = Camera(position=(0.0, 0.0, 0.8), vertical_fov_degrees=120.0), 100 / np.tan(np.radians(60))
    hotspots = find_rings(scenes, camera, (200, 200))
    assert [hotspot.node for hotspot in hotspots] == [2], "0 is behind the camera, no flight leads to 3"
    x, y = hotspots[0].center
    assert x == pytest.approx(100) and y == pytest.approx(100 + focal / 0.8), "1 m below the camera, 0.8 m ahead"
    assert find_clicked(hotspots, (x + 5, y)) == 2
    assert find_clicked(hotspots, (x, y - 60)) is None
    assert [spot.node for spot in find_rings(scenes, replace(camera, yaw_radians=np.pi), (200, 200))] == [0]


def test_a_place_outside_of_the_image_or_under_the_panel_is_an_arrow_to_where_the_camera_turns(house, load_house):
    """So that there is a way on in every direction of every panorama."""
    scenes = TourScenes(house)
    scenes.add(load_house(scenes.make_entry((0, 1))))
    for node, position in enumerate(house.positions):
        scenes.move(position)
        ways = set(house.neighbours(node))
        for yaw, pitch in ((0.0, 0.0), (1.6, 0.4), (3.1, -0.4), (-1.6, 0.0)):
            camera = Camera(tuple(position), yaw, pitch)
            spots = find_spots(scenes, camera, (1280, 720), 290.0)
            assert {spot.node for spot in spots} == ways and all(290 <= spot.center[0] < 1280 for spot in spots)
    camera = Camera(tuple(house.positions[1]), 0.0)
    scenes.move(house.positions[1])
    back, ahead = find_spots(scenes, replace(camera, pitch_radians=-0.4), (1280, 720), 290.0)
    assert (back.node, back.is_arrow, ahead.node, ahead.is_arrow) == (0, True, 2, False), "0 is behind the camera"
    for yaw, side in ((1.2, "left"), (-1.2, "right"), (0.0, "below")):
        spots = find_spots(scenes, replace(camera, yaw_radians=yaw, pitch_radians=0.3), (1280, 720), 290.0)
        (spot,) = [spot for spot in spots if spot.node == 2]
        x, y = spot.center
        assert spot.is_arrow and side == ("below" if y > 600 else "left" if x < 400 else "right")
    assert find_clicked(find_spots(scenes, camera, (1280, 720)), back.center) in (0, 2)


def test_a_hidden_panorama_has_its_hotspot_where_a_link_leads_or_none_while_another_one_is_seen(house, load_house):
    linked = replace(house.panoramas[1], links=(Link("room2", 0.0, 0.6), Link("room0", np.pi, 0.6)))
    tours = house, replace(house, panoramas=(house.panoramas[0], linked, *house.panoramas[2:]))
    camera = Camera(position=(0.0, 0.0, 0.0), vertical_fov_degrees=120.0)
    found = []
    for tour in tours:
        scenes = TourScenes(tour)
        scenes.add(load_house(scenes.make_entry((0, 1))))
        scenes.move(tour.positions[1])
        for hidden in ([], [2], [0, 2]):
            scenes.hidden[1] = hidden
            places = [replace(camera, position=tuple(tour.positions[1]), yaw_radians=yaw) for yaw in (0.0, np.pi)]
            found.append([spot for place in places for spot in find_rings(scenes, place, (200, 200))])
    at_foot, at_link = (100 + 100 / np.tan(np.radians(60)) * slope for slope in (1.0 / 0.8, np.tan(0.6)))
    expected = (
        *({2: at_foot, 0: at_foot}, {0: at_foot}, {0: at_foot}),  # the nearest one stays
        *({2: at_foot, 0: at_foot}, {2: at_link, 0: at_foot}, {2: at_link, 0: at_link}),
    )
    assert [{spot.node: pytest.approx(spot.center[1]) for spot in spots} for spots in found] == list(expected)
