"""The doll's house: panels on the floor and the walls of rooms, with the colours of photographs of boxes."""

import dataclasses
import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
import torch
from PIL import Image
from shapely.geometry import box
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.export.doll_house import DollHouse, _fill, _measure, _pack, _Painter, build_panels, make_house
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.geometry.equirect import pixel_directions
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.tours.houses import Houses
from pansplat.tours.linked_rooms import DrawnPlace
from pansplat.tours.plan import Door, Plan
from pansplat.tours.rooms import Room
from pansplat.tours.scene_graph import make_graph

FLOOR, CEILING = 1.5, -1.1  # from the cameras, downwards
BOXES = (box(0, 0, 5, 4), box(5.2, 0, 8, 4))
CAMERAS = ((1.2, 0.0, 2.0), (3.8, 0.0, 2.2), (6.5, 0.0, 2.0))
PASSAGE = box(5, 1, 5.2, 1.9)  # between the rooms
DOOR = Door(np.array(((5.0, 1.0), (5.0, 1.9))), (0, 1))
ATLAS = 512


@pytest.fixture(autouse=True)
def small_atlas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pansplat.export.doll_house._ATLAS", ATLAS)


def _box_of(view: int) -> tuple[np.ndarray, np.ndarray]:
    left, near, right, far = BOXES[int(view == 2)].bounds
    return np.array((left, CEILING, near)), np.array((right, FLOOR, far))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two rooms: the first one with two cameras."""
    seen = [see_box(*_box_of(view), np.array(place), 20_000) for view, place in enumerate(CAMERAS)]
    gaussians = make_balls(torch.cat(seen), 0.03, views=torch.arange(3).repeat_interleave(20_000))
    return Scene(gaussians, place_cameras(*CAMERAS), 0.3, 12.0, tour=SceneTour(((0, 1, 0.9), (1, 2, 0.3))))


@pytest.fixture(scope="module")
def houses(scene: Scene) -> Houses:
    """One house of the known rooms."""
    outlines = [np.array(box.exterior.coords)[:-1] for box in BOXES]
    found = (Room("", (0, 1), outlines[0], 0, True), Room("", (2,), outlines[1], 0, True))
    plan = Plan(make_graph(scene), found, (DOOR,), FLOOR, None, None, 3, 0)
    return Houses(np.full(3, FLOOR), np.full(3, -CEILING), ((0, 1, 2),), plan)


def _color(places: np.ndarray) -> np.ndarray:
    """The colour of each place of the boxes, 0 to 1."""
    return np.stack((places[..., 0] / 8, (places[..., 1] + 1.5) / 3, places[..., 2] / 4), axis=-1).clip(0, 1)


@pytest.fixture
def photograph(tmp_path: Path) -> Callable[..., list[PanoramaSet]]:
    """A function that writes the photographs; by default of the colours of places, else of one for each camera."""

    def write(*colors: tuple[int, int, int]) -> list[PanoramaSet]:
        pairs = []
        for view, place in enumerate(CAMERAS):
            rays = pixel_directions(256, 512, dtype=torch.float64).numpy()
            low, high = _box_of(view)
            with np.errstate(divide="ignore"):
                reach = (np.where(rays > 0, high, low) - place) / rays
            image = 255 * _color(place + reach.min(axis=-1, keepdims=True) * rays)
            if colors:
                image = np.broadcast_to(np.array(colors[view]), image.shape)
            path = tmp_path / f"{view}.png"
            Image.fromarray(image.round().astype(np.uint8)).save(path)
            panorama = Panorama(f"{view}", path, place_cameras(place)[0])
            pairs.append(PanoramaSet(f"{view}", tmp_path, (panorama,), (), 0.3, 12.0, (path,)))
        return pairs

    return write


def _sample(house: DollHouse, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Random places of all textured triangles, and their colours in the atlas, 0 to 1."""
    triangles = np.array(house.houses[0].corners).reshape(-1, 3, 5)
    triangles = triangles[triangles[..., 3:].max(axis=(1, 2)) <= 1]
    shares = np.random.default_rng(0).dirichlet((1, 1, 1), (count, len(triangles)))
    places, uv = np.split(np.einsum("ntk,tkc->ntc", shares, triangles).reshape(-1, 5), [3], axis=1)
    atlas = np.array(Image.open(io.BytesIO(house.atlas)).convert("RGB")) / 255
    column, row = np.floor(uv * len(atlas)).astype(int).T
    return places, atlas[row, column]


def test_all_is_on_the_floor_or_a_wall_and_has_the_colour_of_its_place(scene, houses, photograph) -> None:
    house = make_house(scene, houses, np.zeros(3), photograph())
    places, colors = _sample(house)
    walls = shapely.union_all([outline.exterior for outline in (*BOXES, PASSAGE)])
    to_wall = shapely.distance(walls, shapely.points(places[:, [0, 2]]))
    assert (np.minimum(to_wall, np.abs(places[:, 1] - FLOOR)) < 1e-6).all()
    assert places[:, 1].min() > CEILING and places[:, 1].max() == pytest.approx(FLOOR)
    is_jamb = (places[:, 0] > 5) & (places[:, 0] < 5.2) & (places[:, 1] < FLOOR)  # which no camera sees
    errors = np.abs(colors - _color(places))[~is_jamb].max(axis=1)
    assert np.median(errors) < 0.02 and np.quantile(errors, 0.95) < 0.06


def test_fronts_face_the_room(houses: Houses) -> None:
    for panel in build_panels(houses, lambda *_: False):
        normal = np.cross(panel.down, panel.right)
        middle = panel.locate(np.array(panel.shape.representative_point().coords[0]))
        if panel.facing is not None:
            assert normal[1] == pytest.approx(-1) and abs(middle[1] - CEILING) < 0.1
        else:
            inside = middle + 0.01 * normal
            assert inside[1] < FLOOR
            assert (BOXES[panel.room] | PASSAGE).buffer(1e-6).contains(shapely.Point(inside[[0, 2]]))


def test_a_door_to_another_room_is_a_gap_in_both_walls_below_its_top(houses: Houses) -> None:
    panels = [panel for panel in build_panels(houses, lambda *_: False) if panel.facing is None]

    def find(place: tuple[float, float, float]) -> list[int]:
        return [
            panel.room
            for panel in panels
            if abs((place - panel.corner) @ np.cross(panel.right, panel.down)) < 1e-6
            and panel.shape.contains(
                shapely.Point((place - panel.corner) @ np.stack((panel.right, panel.down), axis=1))
            )
        ]

    for x, room in ((5.0, 0), (5.2, 1)):
        assert find((x, 0.5, 1.45)) == [] and find((x, 1.4, 1.45)) == []
        assert find((x, -0.9, 1.45)) == [room] and find((x, 0.5, 2.5)) == [room]
    assert find((5.1, FLOOR, 1.45)) == [0] and find((5.1, FLOOR, 2.5)) == [], "the ground below the door"
    assert find((5.1, 0.5, 1.0)) == find((5.1, 0.5, 1.9)) == [0] and find((5.1, -0.9, 1.0)) == [], "the jambs"
    closed = dataclasses.replace(houses, plan=dataclasses.replace(houses.plan, doors=()))
    outward = Door(np.array(((1.0, 0.0), (2.0, 0.0))), (0,))  # a window of a room's height
    window = dataclasses.replace(houses, plan=dataclasses.replace(houses.plan, doors=(outward,)))
    for other in (closed, window):
        panels = [panel for panel in build_panels(other, lambda *_: False) if panel.facing is None]
        assert find((5.0, 0.5, 1.45)) == [0] and find((1.5, 0.5, 0.0)) == [0]


def test_a_place_has_the_colour_of_the_nearest_camera_that_sees_it(scene, houses, photograph) -> None:
    pairs = photograph((200, 0, 0), (0, 0, 200), (0, 200, 0))
    hidden = see_box(np.array((0.5, -2, 1.0)), np.array((0.6, 2, 3.0)), np.array((0.55, 0, 2)), 4000)
    screen = Gaussians.cat([scene.gaussians, make_balls(hidden, 0.03, views=0)])
    for shown, expected in ((scene, 0), (dataclasses.replace(scene, gaussians=screen), 2)):
        house = make_house(shown, houses, np.zeros(3), pairs)
        places, colors = _sample(house, 3000)
        own = colors.argmax(axis=1)
        x, y, z = places.T
        assert (own[x > 5.3] == 1).all(), "another room"
        away = np.linalg.norm(places[:, None] - CAMERAS[:2], axis=2)
        floor = (np.abs(y - FLOOR) < 1e-6) & (x < 4.9) & (x > 1.0)
        clear = floor & (np.abs(away[:, 0] - away[:, 1]) > 0.3)
        tripod = np.linalg.norm(places[:, None] - CAMERAS[:2], axis=2).min(axis=1) < np.hypot(FLOOR, 0.7)
        assert (own[clear & ~tripod] == 2 * (away[:, 1] < away[:, 0])[clear & ~tripod]).all()
        for number, camera in enumerate(CAMERAS[:2]):
            below = floor & (np.hypot(x - camera[0], z - camera[2]) < 0.25)
            assert below.sum() > 5 and (own[below] == 2 - 2 * number).all(), "the tripod"
        behind = (x < 1e-6) & (np.abs(z - 2) < 0.6) & (np.abs(y) < 0.5)
        assert behind.sum() > 5 and (own[behind] == expected).all(), "a surface is in front of the wall"


def test_what_no_camera_sees_has_the_colours_around_it() -> None:
    weight = np.zeros((40, 60), np.float32)
    weight[:, :10], weight[:, 50:] = 1, 1
    color = weight[..., None] * np.linspace(0.2, 0.8, 60)[None, :, None] * np.ones(3)
    filled = _fill(color.astype(np.float32), weight, np.ones(3))
    assert np.allclose(filled[weight > 0], color[weight > 0]) and filled.min() >= 0.19 and filled.max() <= 0.81
    assert np.abs(np.diff(filled, axis=1)).max() < 0.1, "softly"
    nothing = _fill(np.zeros((3, 40, 3), np.float32), np.zeros((3, 40), np.float32), np.array((0.1, 0.5, 0.9)))
    assert np.allclose(nothing, (0.1, 0.5, 0.9)), "of the other walls"


def test_a_room_of_another_world_stands_beside_the_house_on_its_floor(scene: Scene, houses: Houses) -> None:
    """It is turned by a quarter to the right, and its camera is lower."""
    plan = dataclasses.replace(houses.plan, doors=())
    vars(plan)["drawn"] = {2: DrawnPlace(0, math.pi / 2, np.array((8.0, 10.0)))}
    floors = np.array((FLOOR, FLOOR, FLOOR - 0.2))
    apart = dataclasses.replace(houses, plan=plan, floors=floors, views=((0, 1), (2,)))
    (house,) = make_house(scene, apart, np.zeros(3)).houses
    corners, (*_, (turn, *place)) = np.array(house.corners), house.moves
    assert house.nodes == (0, 1, 2) and turn == math.pi / 2
    assert place == pytest.approx((8 + CAMERAS[2][2], 0.2, 10 - CAMERAS[2][0]))
    is_moved, is_wall = corners[:, 0] > 7.5, corners[:, 3:].max(axis=1) <= 1
    low, high = (find(corners[is_moved & is_wall, :3], axis=0) for find in (np.min, np.max))
    assert low[[0, 2]] == pytest.approx((8, 2), abs=1e-3) and high == pytest.approx((12, FLOOR, 4.8), abs=1e-3)
    assert corners[~is_moved & is_wall].max(axis=0)[:3] == pytest.approx((5, FLOOR, 4), abs=1e-3), "the others stay"


def test_textures_of_many_rooms_fit_into_the_atlas(houses: Houses) -> None:
    panels = [panel for panel in build_panels(houses, lambda *_: False) if panel.facing is None] * 12
    density, places = _pack(panels, 100.0)
    boxes = [box(*place, *(place + _measure(panel, density))) for panel, place in zip(panels, places, strict=True)]
    assert shapely.union_all(boxes).area == pytest.approx(sum(each.area for each in boxes)), "none covers another one"
    assert max(max(each.bounds[2:]) for each in boxes) <= ATLAS
    assert density < 100


def test_without_a_house_there_is_no_atlas(scene: Scene, houses: Houses) -> None:
    house = make_house(scene, dataclasses.replace(houses, views=()), np.zeros(3))
    assert (house.houses, house.atlas) == ((), b"")


def test_without_photographs_the_gaussians_are_shown(scene: Scene, houses: Houses) -> None:
    means = scene.gaussians.means
    color = torch.from_numpy(_color(means.numpy()))
    gaussians = make_balls(means, 0.03, 0.99, color=color, views=scene.gaussians.views)
    house = make_house(dataclasses.replace(scene, gaussians=gaussians, height=128), houses, np.zeros(3))
    places, colors = _sample(house)
    assert np.median(np.abs(colors - _color(places)).max(axis=1)) < 0.1


def test_a_wall_that_the_cameras_see_through_is_open(scene: Scene, houses: Houses) -> None:
    own = scene.gaussians.select(scene.gaussians.views != 1)
    seen = make_balls(see_box(_box_of(0)[0], _box_of(2)[1], np.array(CAMERAS[1]), 20_000), 0.03, views=1)
    through = dataclasses.replace(scene, gaussians=Gaussians.cat([own, seen]))
    for shown, expected in ((scene, False), (through, True)):
        painter = _Painter(shown, houses, ())
        assert painter.is_open(0, np.array(((5.0, 0.5), (5.0, 3.5))), FLOOR) == expected
        assert not painter.is_open(0, np.array(((0.0, 3.5), (0.0, 0.5))), FLOOR)
