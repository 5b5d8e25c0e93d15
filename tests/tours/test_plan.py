"""Floor plans of straight walls: rooms with known walls, their files, and refused scenes."""

import dataclasses
import functools
import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import shapely.affinity
import torch
from synthetic_scenes import make_balls

from pansplat.errors import InputError
from pansplat.export.plan_files import _Drawing, describe_plan, write_plan
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.geometry.world import WorldFrame
from pansplat.system.files import is_written
from pansplat.tours import plan as plan_module
from pansplat.tours.facts import TourFacts
from pansplat.tours.plan import Plan, _separate, _Sight

_CEILING, DOOR_TOP, CAMERA_HEIGHT = 2.6, 2.0, 1.5

Wall = tuple[tuple[float, float], tuple[float, float], float]
"""Ends (right, forward) of a wall and the height of its lower edge over the floor, or minus that of its upper one."""


def _walls_around(corners: Sequence[tuple[float, float]], doors: Sequence[Wall] = ()) -> list[Wall]:
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


def _make_house(
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
        to_plane = np.where(rays[:, 1] > 0, CAMERA_HEIGHT, CAMERA_HEIGHT - _CEILING) / rays[:, 1]
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
WALLS = [*_walls_around(L_ROOM, DOOR[:1]), *_walls_around(HALL, DOOR[1:])]
CAMERAS = [(1.5, 1.5), (1.2, 4.5), (7.0, 2.0)]


@functools.cache
def _house() -> Scene:
    return _make_house(WALLS, CAMERAS)


def _plan(scene: Scene) -> Plan:
    return TourFacts(scene).plan


def _measure_angles(outline: np.ndarray) -> list[float]:
    """Angles at the corners, degrees."""
    before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.degrees(np.arctan2(cross, (before * after).sum(axis=1))).tolist()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_rooms_have_their_areas_angles_and_corners(noise: float) -> None:
    plan = _plan(_make_house(WALLS, CAMERAS, turn_degrees=17, noise=noise))
    assert [(room.panoramas, len(room.outline)) for room in plan.rooms] == [((0, 1), 6), ((2,), 4)]
    assert [room.shape.area for room in plan.rooms] == pytest.approx([24.0, 15.6], rel=0.02)
    turn = math.radians(17)
    axes = np.array(((math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))))
    for room, corners in zip(plan.rooms, (L_ROOM, HALL), strict=True):
        assert sorted(abs(angle) for angle in _measure_angles(room.outline)) == pytest.approx([90] * len(corners))
        distances = np.linalg.norm(room.outline[:, None] - np.array(corners) @ axes, axis=2).min(axis=0)
        assert distances.max() < 0.08
    assert plan.camera_height == pytest.approx(CAMERA_HEIGHT, rel=0.01)


def test_a_room_of_two_panoramas_has_their_common_name_and_its_area(tmp_path: Path) -> None:
    scene = _make_house(WALLS, CAMERAS, names=("living room", "living room", "hall"), count=20000)
    file = tmp_path / "plan.svg"
    assert [room.name for room in write_plan(scene, file).rooms] == ["living room", "hall"]
    assert is_written(file)
    texts = [element.text for element in ElementTree.parse(file).iter() if element.tag.endswith("}text")]
    for name, area in (("living room", 24.0), ("hall", 15.6)):
        label = texts[texts.index(name) + 1]
        assert float(label.split()[0]) == pytest.approx(area, rel=0.05) and "m²" in label


def test_an_oblique_wall_stays_oblique() -> None:
    corners = [(0.0, 0.0), (5.0, 0.0), (5.0, 2.0), (3.0, 4.0), (0.0, 4.0)]
    (room,) = _plan(_make_house(_walls_around(corners), [(2.0, 1.8)])).rooms
    assert room.shape.area == pytest.approx(18.0, rel=0.02)
    assert sorted(_measure_angles(room.outline)) == pytest.approx([45, 45, 90, 90, 90], abs=1)


def test_a_door_is_where_the_floor_beyond_is_seen_and_joins_both_rooms() -> None:
    plan = _plan(_house())
    (door,) = plan.doors
    assert sorted(door.rooms) == [0, 1]
    assert door.ends.mean(axis=0) == pytest.approx((5.05, 1.45), abs=0.1)
    assert np.linalg.norm(door.ends[1] - door.ends[0]) == pytest.approx(0.9, abs=0.2)
    closed = _make_house([*_walls_around(L_ROOM), *_walls_around(HALL)], CAMERAS)
    assert _plan(closed).doors == ()


def test_a_window_above_a_sill_is_no_door() -> None:
    """The opening starts 0.9 m over the floor."""
    sills = [(start, end, -0.9) for start, end, lower in WALLS if lower]
    assert len(sills) == 2 and _plan(_make_house([*WALLS, *sills], CAMERAS)).doors == ()


def test_the_uncertainty_of_walls_is_the_disagreement_of_the_panoramas_that_show_them() -> None:
    exact = _plan(_house())
    assert exact.wall_error == pytest.approx(0, abs=0.005) and exact.num_walls >= 6
    shifted = _plan(_make_house(WALLS, CAMERAS, shifts=((0.03, 0.03), (-0.03, -0.03), (0, 0))))
    assert shifted.wall_error == pytest.approx(0.06 / math.sqrt(2), rel=0.25)
    room = shifted.rooms[0]
    walls = math.sqrt(sum(side**2 for side in (5, 3, 2, 3, 3, 6)))
    expected = math.hypot(shifted.wall_error * walls, 0.2 * room.shape.area)
    assert shifted.area_error(room) == pytest.approx(expected, rel=0.05)
    alone = _plan(_make_house(_walls_around(HALL), CAMERAS[2:]))
    assert alone.wall_error is None and alone.scale_error is None
    assert alone.area_error(alone.rooms[0]) == pytest.approx(0.2 * 15.6, rel=0.05), "of its shape"


def test_rooms_do_not_depend_on_how_many_gaussians_show_a_surface() -> None:
    """A row of books before a wall, which a third of each ray below the ceiling meets, has the most detail."""
    plain = _house()
    means, labels = plain.gaussians.means, plain.gaussians.views
    place = torch.stack([plain.cam2world[k, :3, 3] for k in range(3)]).to(means)[labels.long()]
    offset = means - place
    height, angle = -offset[:, 1] / (_CEILING - CAMERA_HEIGHT), torch.atan2(offset[:, 0], offset[:, 2])
    is_book = (height > 0.6) & (height < 0.68) & (angle.abs() < 0.6)
    moved = torch.where(is_book[:, None], place + 0.6 * offset, means)
    moved[is_book, 1] = means[is_book, 1]
    shelf = dataclasses.replace(plain, gaussians=dataclasses.replace(plain.gaussians, means=moved))
    books = shelf.gaussians.select(is_book)
    detailed = dataclasses.replace(shelf, gaussians=Gaussians.cat([shelf.gaussians, *[books] * 15]))
    few, many = _plan(shelf), _plan(detailed)
    assert [room.panoramas for room in few.rooms] == [room.panoramas for room in many.rooms] == [(0, 1), (2,)]
    for room, other in zip(few.rooms, many.rooms, strict=True):
        assert other.outline == pytest.approx(room.outline, abs=0.02)


def test_a_place_that_two_rooms_have_in_common_belongs_to_the_one_whose_camera_is_there() -> None:
    """The middle of the corridor is nearer to the camera of the other room."""
    places = np.empty((0, 2))
    sights = {k: _Sight(np.array(center), places, places, places) for k, center in enumerate(((1.0, 0.5), (5.0, 1.5)))}
    shapes = [((0,), shapely.box(0, 0, 10, 1)), ((1,), shapely.box(0, 0, 10, 4))]
    first, second = (shape for _, shape in _separate(shapes, sights))
    assert first.equals(shapely.box(0, 0, 10, 1)) and second.equals(shapely.box(0, 1, 10, 4))


def test_each_camera_of_a_room_is_in_its_outline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another room takes the place of the second camera."""
    taken = shapely.box(-1, 4, 4, 7)
    monkeypatch.setattr(plan_module, "_separate", lambda shapes, _: [(n, shape - taken) for n, shape in shapes])
    plan = _plan(_house())
    assert [room.panoramas for room in plan.rooms if room.is_closed] == [(0,), (2,)]
    assert any(line.endswith("walls do not close around panorama 2") for line in describe_plan(plan))


def test_a_room_whose_walls_do_not_close_is_a_rectangle_by_its_floor_beside_other_rooms() -> None:
    """The last camera sees half of the walls below the ceiling."""
    scene = _house()
    means, is_last = scene.gaussians.means, scene.gaussians.views == 2
    is_hidden = is_last & (means[:, 1] < -0.2) & (means[:, 0] < 7.5)
    plan = _plan(dataclasses.replace(scene, gaussians=scene.gaussians.select(~is_hidden)))
    assert [(room.panoramas, room.is_closed) for room in plan.rooms] == [((0, 1), True), ((2,), False)]
    shape = shapely.Polygon(plan.rooms[1].outline)
    assert shape.bounds == pytest.approx((5.0, 0.0, 9.0, 4.0), abs=0.2)
    assert shape.intersection(shapely.Polygon(plan.rooms[0].outline)).area < 0.01


def test_a_room_without_a_ceiling_ends_where_its_floor_does() -> None:
    scene = _make_house(_walls_around(HALL), CAMERAS[2:])
    open_room = scene.gaussians.select(scene.gaussians.means[:, 1] > -0.8)
    (room,) = _plan(dataclasses.replace(scene, gaussians=open_room)).rooms
    assert room.shape.area == pytest.approx(15.6, rel=0.05)


def _two_storeys() -> Scene:
    return _make_house(
        _walls_around(HALL),
        [(7, 2), (6.5, 1), (7, 2.5), (7.5, 1)],
        floors=(0, 0, 3, 3),
        names=["Hall", "Hall", "Attic", "x<y"],
    )


def _read_svg(path: Path) -> tuple[list[np.ndarray], str]:
    """Corners of the rooms in metres, and all texts."""
    root = ElementTree.parse(path).getroot()
    paths = [node for node in root.iter() if node.tag.endswith("}polygon")]
    rooms = [np.array(re.findall(r"-?[\d.]+", node.get("points")), float).reshape(-1, 2) for node in paths]
    metre = 0.02 / 0.0254 * 72
    return [room / metre for room in rooms], "\n".join(n.text for n in root.iter() if n.tag.endswith("text"))


def _area(corners: np.ndarray | Sequence) -> float:
    x, y = np.array(corners).T
    return abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1))) / 2


def test_storeys_are_next_to_each_other_in_metres_with_names_and_areas(tmp_path: Path) -> None:
    path = tmp_path / "plan.svg"
    plan = write_plan(_two_storeys(), path)
    rooms, text = _read_svg(path)
    assert [_area(room) for room in rooms] == pytest.approx([15.6, 15.6], rel=0.02)
    assert rooms[0][:, 0].max() < rooms[1][:, 0].min(), "the lower storey is on the left"
    for expected in ("Hall", "Attic / x<y", "15.6 m²", "4.00", "3.90", *describe_plan(plan)):
        assert any(line.startswith(expected) for line in text.split("\n")), expected


def test_a_room_at_an_approximate_place_is_dashed_where_its_neighbour_has_it(tmp_path: Path) -> None:
    """The hall is in a world of its own, and then half a metre farther to the right than in one world."""
    house = _house()
    scene = dataclasses.replace(house, tour=SceneTour(((0, 1, 0.5), (2, 2, 1.0)), (), ((2, 0, 6.0, 0.5, 0.0),)))
    drawings = [_Drawing(_plan(each)) for each in (house, scene)]
    offsets = [
        np.subtract(*(drawing.outline(room).mean(axis=0) for room in drawing.plan.rooms)) for drawing in drawings
    ]
    turn = np.array(((math.cos(drawings[1].plan.turns[0]),), (math.sin(drawings[1].plan.turns[0]),)))[:, 0]
    assert offsets[1] - offsets[0] == pytest.approx(-0.5 * turn, abs=0.02)
    assert drawings[1].panoramas[2] - drawings[1].panoramas[0] == pytest.approx(
        drawings[0].panoramas[2] - drawings[0].panoramas[0] + 0.5 * turn, abs=2e-3
    )
    write_plan(scene, tmp_path / "plan.svg")
    text, known = (tmp_path / "plan.svg").read_text(), _plan(scene).rooms
    assert [room.is_placed for room in known] == [True, False] and "stroke-dasharray" in text
    assert _read_svg(tmp_path / "plan.svg")[1].count("about here") == 1


def test_texts_are_neither_on_walls_nor_on_dots_nor_on_one_another() -> None:
    """The hall is at an approximate place over the corner of the L, and a camera without walls is beside a wall."""
    names = ("Living room", "Living room", "Hall", "Closet")
    house = _make_house(WALLS, [*CAMERAS, (5.0, 4.2)], names=names)
    scene = dataclasses.replace(
        house,
        gaussians=house.gaussians.select(house.gaussians.views < 3),
        tour=SceneTour(((0, 1, 0.5), (1, 3, 0.5), (2, 2, 1.0)), (), ((2, 0, 1.6, 0.4, 0.0),)),
    )
    drawing = _Drawing(_plan(scene))
    assert [room.panoramas for room in drawing.plan.rooms] == [(0, 1), (3,), (2,)]
    walls = shapely.union_all([shapely.Polygon(drawing.outline(room)).exterior for room in drawing.plan.rooms])
    covers = []
    for text in drawing.list_texts():
        width, (x, y) = 0.7 * text.size * len(text.text), text.place
        left = x - width / 2 if text.is_centred else x
        box = shapely.box(left, y - text.size / 2, left + width, y + text.size / 2)
        covers.append(shapely.affinity.rotate(box, text.angle))
        assert not covers[-1].intersects(walls), text
        assert min(covers[-1].distance(shapely.Point(dot)) for dot in drawing.panoramas) > 0.06, text
    assert len(covers) > 8 and shapely.union_all(covers).area == pytest.approx(sum(c.area for c in covers))


def test_the_picture_is_the_drawing(tmp_path: Path) -> None:
    write_plan(_house(), tmp_path / "plan.png")
    image = cv2.imread(str(tmp_path / "plan.png"))
    assert is_written(tmp_path / "plan.png") and (image[:3] == 255).all()
    assert np.abs(image[..., ::-1].astype(int) - (242, 240, 234)).sum(axis=2).min() == 0


@pytest.mark.parametrize(("unit", "wall", "area"), [(1e3, "4000", "15"), (1e-3, "0.00400", "0.00001")])
def test_lengths_are_in_the_unit_of_the_poses(tmp_path: Path, unit: float, wall: str, area: str) -> None:
    metres = _make_house(_walls_around(HALL), CAMERAS[2:])
    scene = dataclasses.replace(metres, frame=WorldFrame(unit))
    plan = write_plan(scene, tmp_path / "plan.svg")
    (room,), text = _read_svg(tmp_path / "plan.svg")
    assert _area(room) == pytest.approx(15.6, rel=0.02), "on paper it has the size of a room in metres"
    lines = text.split("\n")
    assert wall in lines and f"1:{50 * unit:g} on paper; the bar is {unit:g} m" in lines
    assert any(line.startswith(area) and "m² ±" in line for line in lines)
    height = float(re.search(r"cameras ([\d.]+) m over", text)[1])
    assert height == pytest.approx(CAMERA_HEIGHT * unit, rel=0.01)
    assert describe_plan(plan) != describe_plan(write_plan(metres, tmp_path / "metres.svg"))


@pytest.mark.parametrize("degrees", [0, 30, 90, 200])
def test_the_longest_wall_is_horizontal_and_lengths_are_read_from_below_or_the_right(degrees: float) -> None:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    corners = [(c * x - s * z, s * x + c * z) for x, z in ((0, 0), (5, 0), (5, 3), (0, 3))]
    plan = _plan(_make_house(_walls_around(corners), [(c * 2 - s * 1.5, s * 2 + c * 1.5)]))
    drawing = _Drawing(plan)
    sides = np.diff(drawing.outline(plan.rooms[0]), axis=0)
    longest = sides[np.linalg.norm(sides, axis=1).argmax()]
    assert abs(longest[1]) < 0.02 * abs(longest[0])
    lengths = {text.text: text.angle for text in drawing.list_texts() if text.layer == "LENGTHS"}
    assert all(min(abs(angle), abs(angle - 90)) < 2 for angle in lengths.values()), lengths


def test_a_room_that_is_not_placed_is_upright_beside_the_others_and_no_camera_hides_a_name() -> None:
    plan = _plan(_make_house(WALLS, CAMERAS, names=("living room", "living room", "the hall of the house")))
    c, s = math.cos(0.3), math.sin(0.3)
    hall = plan.rooms[1].outline @ np.array(((c, s), (-s, c)))  # it would cover a part of the other room
    lost = dataclasses.replace(plan.rooms[1], outline=hall, is_placed=False)
    tour = dataclasses.replace(plan.tour, overlaps={(0, 1): 0.5, (2, 2): 1.0})
    drawing = _Drawing(dataclasses.replace(plan, tour=tour, rooms=(plan.rooms[0], lost), doors=()))
    living, hall = (drawing.outline(room) for room in drawing.plan.rooms)
    assert hall.min(axis=0)[0] > living.max(axis=0)[0] + 1 and (np.array(drawing.size) > hall.max(axis=0)).all()
    sides = np.diff(hall, axis=0)
    assert np.abs(sides).min(axis=1) == pytest.approx(0, abs=1e-9)
    assert "dashed: rooms whose places are not known" in drawing.notes
    for text in drawing.list_texts():
        away = np.abs(drawing.panoramas - text.place)
        assert text.layer != "ROOMS" or (away > (0.3 * len(text.text) * text.size, 0.5 * text.size)).any(axis=1).all()


def test_scenes_without_a_plan_are_refused(tmp_path: Path) -> None:
    scene = _make_house(_walls_around(HALL), CAMERAS[2:])
    few = dataclasses.replace(scene, gaussians=scene.gaussians.select(torch.arange(5)))
    none = dataclasses.replace(few, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64), tour=None, names=())
    for bad in (few, none):
        with pytest.raises(InputError, match="needed a floor, and walls around"):
            write_plan(bad, tmp_path / "plan.svg")
    with pytest.raises(InputError, match="exported with --layers"):
        write_plan(dataclasses.replace(scene, joint=True), tmp_path / "plan.svg")
    assert not list(tmp_path.iterdir())
