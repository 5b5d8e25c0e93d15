"""The pictures of a folder as panoramas without poses; links.json gives them titles, links and start views."""

import json
from pathlib import Path

import numpy as np
import pytest
from panorama_fixtures import write_grey
from PIL import Image

from pansplat.images.image_files import read_panorama
from pansplat.inputs.folders import load_panoramas
from pansplat.inputs.panorama_sets import Link, Note
from pansplat.inputs.photographs import write_notes


def test_panoramas_and_faces_of_a_folder_are_listed_by_name(tmp_path, write_scene, color_face, check_colors) -> None:
    write_scene(tmp_path / "hall.jpg", 64)
    write_scene(tmp_path / "hall.png", 32)
    write_scene(tmp_path / "hall_jpg.jpg", 32)
    for face in "frblud":
        Image.fromarray(color_face(face, 16)).save(tmp_path / f"attic_{face}.png")
    panoramas = load_panoramas(tmp_path)
    assert [panorama.name for panorama in panoramas] == ["attic", "hall_jpg", "hall_jpg_2", "hall_png"]
    for panorama in panoramas:
        check_colors(read_panorama(panorama.image, 32)[0])


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_a_damaged_picture_is_named_and_the_others_open(tmp_path: Path, write_scene, suffix: str) -> None:
    for name in "ab":
        write_scene(tmp_path / f"{name}.{suffix}", 64)
    whole = (tmp_path / f"b.{suffix}").read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    for content in (whole[:-30], *([flipped] if suffix == "png" else [])):
        (tmp_path / f"b.{suffix}").write_bytes(content)
        with pytest.warns(UserWarning, match=rf"left out: .*b\.{suffix}: needed a complete image"):
            assert [panorama.name for panorama in load_panoramas(tmp_path)] == ["a"]


def test_a_picture_with_other_data_behind_it_is_whole(tmp_path: Path, write_scene) -> None:
    write_scene(tmp_path / "a.jpg", 64)
    with open(tmp_path / "a.jpg", "ab") as file:
        file.write(b"SEFT" * 9)  # as some phones do
    assert len(load_panoramas(tmp_path)) == 1


def test_own_renderings_count_only_if_there_is_nothing_else(tmp_path: Path, write_scene) -> None:
    for name in ("out.png", "out_2.jpg"):
        write_grey(tmp_path / name)
    Image.new("RGB", (20, 20)).save(tmp_path / "logo.png")
    with pytest.warns(UserWarning, match=r"logo\.png: needed a 2:1"):
        assert [panorama.name for panorama in load_panoramas(tmp_path)] == ["out", "out_2"]
    (tmp_path / "logo.png").unlink()
    write_scene(tmp_path / "photo.jpg")
    with (
        pytest.warns(UserWarning, match=r"left out: .*out\.png: it was rendered by pansplat"),
        pytest.warns(UserWarning, match=r"out_2\.jpg: it was rendered"),
    ):
        assert [panorama.name for panorama in load_panoramas(tmp_path)] == ["photo"]


@pytest.fixture
def rooms(tmp_path: Path, write_scene) -> Path:
    for name in ("p01", "p02"):
        write_scene(tmp_path / f"{name}.jpg", 8)
    return tmp_path


def _link(folder: Path, content: object) -> list:
    (folder / "links.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return load_panoramas(folder)


def test_links_titles_and_start_views_are_read(rooms: Path) -> None:
    second = {"title": " <b>Kitchen</b>\n", "start": [4, -0.1], "links": [{"to": "p01", "yaw": -1}]}
    first = [{"to": "p02.jpg", "yaw": 7, "pitch": 0.2, "text": "to the kitchen"}]
    one, two = _link(rooms, {"p01.jpg": first, "p02": second})
    assert one.links == (Link("p02", pytest.approx(7 - 2 * np.pi), 0.2, "to the kitchen"),)
    assert (one.title, one.start) == ("", None)
    assert two.label == "<b>Kitchen</b>"
    assert two.start == pytest.approx((4 - 2 * np.pi, -0.1))
    assert two.links == (Link("p01", -1.0),)


def test_notes_are_read_and_written_and_all_else_stays(rooms: Path) -> None:
    links, note = [{"to": "p02.jpg", "yaw": 0.5}], Note(0.1, -0.2, "1 < 2 % <b>", ("https://example.com/a",))
    stated = {
        "yaw": 0.1,
        "pitch": -0.2,
        "text": "1 < 2 % <b>\n\n",
        "addresses": ["https://example.com/a", "file:///b", 3],
    }
    one, two = _link(
        rooms, {"p01.jpg": links, "p02": {"title": "Bad", "notes": [stated, {"yaw": 1}], "colour": "blue"}}
    )
    assert one.notes == () and two.notes == (note,)
    write_notes(one, [note])
    write_notes(two, [Note(3, 0, "window")])
    one, two = load_panoramas(rooms)
    assert one.notes == (note,) and one.links == (Link("p02", 0.5),)
    assert two.notes == (note, Note(3, 0, "window")) and two.title == "Bad"
    write_notes(two, [], lambda note: True)
    content = json.loads((rooms / "links.json").read_text("utf-8"))
    assert content["p02"] == {"title": "Bad", "notes": [], "colour": "blue"} and content["p01.jpg"]["links"] == links
    assert load_panoramas(rooms)[1].notes == ()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"p01.jpg": [{"to": "p09.jpg", "yaw": 0}]}, "p01.*'p09.jpg'"),
        ({"p09.jpg": []}, "'p09.jpg'"),
        ({"p01.jpg": [{"to": "p02.jpg"}]}, "p01.*yaw.*None"),
        ({"p01.jpg": [{"to": "p02.jpg", "yaw": "right"}]}, "p01.*yaw"),
        ({"p01.jpg": 5}, "p01.*object"),
        ({"p01.jpg": {"notes": [{"yaw": 0, "text": 5}]}}, "p01.*text"),
        ({"p01.jpg": {"notes": [{"yaw": "left", "text": "a"}]}}, "p01.*yaw"),
        ({"p01.jpg": {"start": [1]}}, "p01.*start"),
        ("<html>", r"links\.json.*JSON"),
        ([], r"links\.json.*object"),
    ],
)
def test_faulty_links_are_named_and_the_panoramas_open(rooms: Path, content: object, message: str) -> None:
    with pytest.warns(UserWarning, match=message):
        panoramas = _link(rooms, content)
    assert [(panorama.name, panorama.links) for panorama in panoramas] == [("p01", ()), ("p02", ())]


@pytest.mark.shared
@pytest.mark.parametrize(("tour", "count", "links"), [("flat_3", 3, 1), ("flat_5", 5, None), ("empty_house", 10, None)])
def test_real_tours_are_listed_with_their_links(shared: Path, tour: str, count: int, links: int | None) -> None:
    panoramas = load_panoramas(shared / "data" / "tours" / tour)
    stated = json.loads((shared / "data" / "tours" / tour / "links.json").read_text())
    assert len(panoramas) == count
    assert sum(len(p.links) for p in panoramas) == (links or sum(map(len, stated.values())))
