"""Floor plans as drawings: storeys, names and lengths, and scenes without a plan."""

import dataclasses
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
from synthetic_houses import CAMERA_HEIGHT, CAMERAS, HALL, WALLS, make_plan, make_rooms, make_walls_scene, walls_around

from pansplat.errors import InputError
from pansplat.export.plan_files import _Drawing, describe_plan, write_plan
from pansplat.gaussians.scene import Scene, SceneTour
from pansplat.geometry.world import WorldFrame
from pansplat.system.files import is_written


def test_a_room_of_two_panoramas_has_their_common_name_and_its_area(tmp_path: Path) -> None:
    scene = make_walls_scene(WALLS, CAMERAS, names=("living room", "living room", "hall"), count=20000)
    file = tmp_path / "plan.svg"
    assert [room.name for room in write_plan(scene, file).rooms] == ["living room", "hall"]
    assert is_written(file)
    texts = [element.text for element in ElementTree.parse(file).iter() if element.tag.endswith("}text")]
    for name, area in (("living room", 24.0), ("hall", 15.6)):
        label = texts[texts.index(name) + 1]
        assert float(label.split()[0]) == pytest.approx(area, rel=0.05) and "m²" in label


def _two_storeys() -> Scene:
    return make_walls_scene(
        walls_around(HALL),
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
    house = make_rooms()
    scene = dataclasses.replace(house, tour=SceneTour(((0, 1, 0.5), (2, 2, 1.0)), (), ((2, 0, 6.0, 0.5, 0.0),)))
    drawings = [_Drawing(make_plan(each)) for each in (house, scene)]
    offsets = [
        np.subtract(*(drawing.outline(room).mean(axis=0) for room in drawing.plan.rooms)) for drawing in drawings
    ]
    turn = np.array(((math.cos(drawings[1].plan.turns[0]),), (math.sin(drawings[1].plan.turns[0]),)))[:, 0]
    assert offsets[1] - offsets[0] == pytest.approx(-0.5 * turn, abs=0.02)
    assert drawings[1].panoramas[2] - drawings[1].panoramas[0] == pytest.approx(
        drawings[0].panoramas[2] - drawings[0].panoramas[0] + 0.5 * turn, abs=2e-3
    )
    write_plan(scene, tmp_path / "plan.svg")
    text, known = (tmp_path / "plan.svg").read_text(), make_plan(scene).rooms
    assert [room.is_placed for room in known] == [True, False] and "stroke-dasharray" in text
    assert _read_svg(tmp_path / "plan.svg")[1].count("about here") == 1


def test_a_room_with_a_link_from_one_side_only_is_a_dot_that_is_named_and_not_counted() -> None:
    house = make_rooms()
    tour = SceneTour(((0, 1, 0.5), (2, 2, 1.0)), ((0, 2, 0.5, 0.0, ""),))
    known, plan = make_plan(house), make_plan(dataclasses.replace(house, tour=tour))
    name = plan.tour.panoramas[2].label
    assert len(_Drawing(plan).rooms) == len(_Drawing(known).rooms) - 1
    assert describe_plan(known)[0].startswith("2 rooms") and describe_plan(plan)[0].startswith("1 room,")
    lines = [line for line in describe_plan(plan) if name in line]
    assert len(lines) == 1 and lines[0].startswith("dots")


def test_texts_are_neither_on_walls_nor_on_dots_nor_on_one_another() -> None:
    """The hall is at an approximate place over the corner of the L, and a camera without walls is beside a wall."""
    names = ("Living room", "Living room", "Hall", "Closet")
    house = make_walls_scene(WALLS, [*CAMERAS, (5.0, 4.2)], names=names)
    scene = dataclasses.replace(
        house,
        gaussians=house.gaussians.select(house.gaussians.views < 3),
        tour=SceneTour(((0, 1, 0.5), (1, 3, 0.5), (2, 2, 1.0)), (), ((2, 0, 1.6, 0.4, 0.0),)),
    )
    drawing = _Drawing(make_plan(scene))
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
    write_plan(make_rooms(), tmp_path / "plan.png")
    image = cv2.imread(str(tmp_path / "plan.png"))
    assert is_written(tmp_path / "plan.png") and (image[:3] == 255).all()
    assert np.abs(image[..., ::-1].astype(int) - (242, 240, 234)).sum(axis=2).min() == 0


@pytest.mark.parametrize(("unit", "wall", "area"), [(1e3, "4000", "15"), (1e-3, "0.00400", "0.00001")])
def test_lengths_are_in_the_unit_of_the_poses(tmp_path: Path, unit: float, wall: str, area: str) -> None:
    metres = make_walls_scene(walls_around(HALL), CAMERAS[2:])
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
    plan = make_plan(make_walls_scene(walls_around(corners), [(c * 2 - s * 1.5, s * 2 + c * 1.5)]))
    drawing = _Drawing(plan)
    sides = np.diff(drawing.outline(plan.rooms[0]), axis=0)
    longest = sides[np.linalg.norm(sides, axis=1).argmax()]
    assert abs(longest[1]) < 0.02 * abs(longest[0])
    lengths = {text.text: text.angle for text in drawing.list_texts() if text.layer == "LENGTHS"}
    assert all(min(abs(angle), abs(angle - 90)) < 2 for angle in lengths.values()), lengths


def test_a_room_that_is_not_placed_is_upright_beside_the_others_and_no_camera_hides_a_name() -> None:
    plan = make_plan(make_walls_scene(WALLS, CAMERAS, names=("living room", "living room", "the hall of the house")))
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
    scene = make_walls_scene(walls_around(HALL), CAMERAS[2:])
    few = dataclasses.replace(scene, gaussians=scene.gaussians.select(torch.arange(5)))
    none = dataclasses.replace(few, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64), tour=None, names=())
    for bad in (few, none):
        with pytest.raises(InputError, match="needed a floor, and walls around"):
            write_plan(bad, tmp_path / "plan.svg")
    with pytest.raises(InputError, match="exported with --layers"):
        write_plan(dataclasses.replace(scene, joint=True), tmp_path / "plan.svg")
    assert not list(tmp_path.iterdir())
