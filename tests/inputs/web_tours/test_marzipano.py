"""Exports of the Marzipano Tool open with their pictures, names, links and start views, whatever else is broken."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from refusals import expect_error

from pansplat.cli import run
from pansplat.images.image_files import read_height, read_panorama
from pansplat.inputs.folders import load_panoramas, load_sets
from pansplat.inputs.panorama_sets import Link, Note, Panorama
from pansplat.poses.edit import PoseEditor, name_pictures
from pansplat.poses.files import _describe

LEVELS = [
    {"tileSize": 16, "size": 16, "fallbackOnly": True},
    {"tileSize": 32, "size": 32},
    {"tileSize": 32, "size": 64},
]


def _scene(key: str, **content: Any) -> dict[str, Any]:
    return {
        "id": key,
        "name": key[2:].capitalize(),
        "levels": LEVELS,
        "faceSize": 60,
        "initialViewParameters": {"yaw": 0.5, "pitch": 0.1, "fov": 1.3},
        "linkHotspots": [],
        "infoHotspots": [],
    } | content


Export = Callable[..., Path]


@pytest.fixture
def export(tmp_path: Path, write_tiles) -> Export:
    """Write an export with these scenes; returns the folder."""

    def write(*scenes: Any, first: int = 0, name: object = "Flat") -> Path:
        data = {"scenes": list(scenes), "name": name, "settings": {"mouseViewMode": "drag"}}
        (tmp_path / "data.js").write_text(f"var APP_DATA = {json.dumps(data, indent=2)};\n")
        (tmp_path / "index.html").write_text("<!DOCTYPE html><script src='data.js'></script>")
        for scene in scenes:
            base = tmp_path / "tiles" / scene["id"]
            for level, content in enumerate(scene["levels"], start=first):
                if level:
                    write_tiles(
                        content["size"],
                        content["tileSize"],
                        lambda f, r, c, b=base / str(level): b / f / str(r) / f"{c}.jpg",
                    )
        return tmp_path

    return write


def _check_picture(panorama: Panorama, check_colors, size: int = 64) -> None:
    assert read_height(panorama.image) == 2 * size
    check_colors(read_panorama(panorama.image, 2 * size)[0])
    check_colors(read_panorama(panorama.image, 16)[0])


def test_an_export_has_its_pictures_names_links_and_start_views(export: Export, check_colors) -> None:
    spot = {"yaw": 3.0, "pitch": 0.25, "rotation": 0, "target": "1-kitchen"}
    back = {"yaw": -0.1 - 2 * math.pi, "pitch": -0.2, "target": "0-hall"}
    script = "<script>alert('x')</script>\n\u2028\0 & more"
    scenes = _scene("0-hall", name=script, linkHotspots=[spot]), _scene("1-kitchen", name="", linkHotspots=[back])
    hall, kitchen = load_panoramas(export(*scenes) / "data.js")
    assert (hall.name, hall.label, kitchen.label) == ("0-hall", "<script>alert('x')</script> & more", "1-kitchen")
    assert hall.links == (Link("1-kitchen", 3.0, 0.25),)
    assert kitchen.links[0].target == "0-hall"
    assert (kitchen.links[0].yaw, kitchen.links[0].pitch) == pytest.approx((-0.1, -0.2))
    assert hall.start == (0.5, 0.1)
    _check_picture(hall, check_colors)
    _check_picture(kitchen, check_colors)


def test_messages_name_rooms_by_their_titles(export: Export) -> None:
    folder = export(_scene("0-hall", name="Entrance"), _scene("1-kitchen"))
    expect_error(r"got images only \(Entrance, Kitchen\)", load_sets, folder)
    assert [_describe(view, folder) for view in load_panoramas(folder)] == [f"{folder}: Entrance", f"{folder}: Kitchen"]


def test_poses_beside_the_tour_keep_its_titles_links_and_start_views(export: Export) -> None:
    spots = [[{"yaw": 3.0, "target": "1-kitchen"}], [{"yaw": 0.0, "target": "0-hall"}], []]
    keys = "0-hall", "1-kitchen", "2-bath"
    folder = export(*(_scene(key, linkHotspots=spot) for key, spot in zip(keys, spots, strict=True)))
    poses = {name: np.eye(4).tolist() for name in ("0-hall", "1-kitchen")}
    poses["1-kitchen"][0][3] = 2.0
    reasons = {"unplaced": {"2-bath.cube.json": "bare walls"}}
    content = {"convention": "cam2world opencv", "poses": poses, "estimate": reasons}
    (folder / "poses.json").write_text(json.dumps(content))
    for path in (folder, folder / "data.js", folder / "poses.json"):
        placed, alone = load_sets(path)
        hall, kitchen = placed.context
        assert (hall.title, kitchen.title, hall.start) == ("Hall", "Kitchen", (0.5, 0.1))
        assert [link.target for view in placed.context for link in view.links] == ["1-kitchen", "0-hall"]
        assert float((kitchen.cam2world - hall.cam2world)[:3, 3].norm()) == pytest.approx(2.0)
        assert alone.context[0].title == "Bath" and alone.context[0].placement.reason == "bare walls"
    panoramas = [*placed.context, *alone.context]
    pose = np.eye(4)
    pose[2, 3] = 3.0
    editor = PoseEditor(folder, panoramas)
    editor.place({alone.context[0].image: pose}, 0)
    assert set(json.loads((folder / "poses.json").read_text())["poses"]) == {"0-hall", "1-kitchen", "2-bath"}
    assert sum(len(pair.context) for pair in load_sets(folder)) == 4, "two pairs of three panoramas"
    names = name_pictures(folder / "poses.json", [view.image for view in panoramas])
    assert set(names.values()) == {"0-hall", "1-kitchen", "2-bath"}, "those of an estimate"


def test_a_tour_comes_out_of_its_tiles_as_photographs(export: Export, check_colors, tmp_path_factory, capsys) -> None:
    spot = {"yaw": 3.0, "pitch": 0.25, "target": "1-kitchen"}
    folder = export(_scene("0-hall", linkHotspots=[spot]), _scene("1-kitchen", name="Küche"))
    own = {"0-hall": {"notes": [{"yaw": 1.0, "pitch": 0.1, "text": "sofa"}]}}
    (folder / "links.json").write_text(json.dumps(own))
    out = tmp_path_factory.mktemp("photos") / "panoramas"
    assert run(["export", str(folder), "-o", str(out), "--photos"]) == 0
    assert "2 photographs" in capsys.readouterr().out
    assert sorted(file.name for file in out.iterdir()) == ["0-hall.jpg", "1-kitchen.jpg", "links.json"]
    assert read_height(out / "0-hall.jpg") == 128
    check_colors(read_panorama(out / "0-hall.jpg", 128)[0], tolerance=8)  # two generations of JPEG
    before, after = load_panoramas(folder), load_panoramas(out)
    for old, new in zip(before, after, strict=True):
        assert (new.name, new.title, new.start, new.links) == (old.name, old.title, old.start, old.links)
        assert new.notes == old.notes
    assert before[0].links and before[0].notes == (Note(1.0, 0.1, "sofa"),), "links.json adds to what the tour states"
    assert run(["export", str(folder), "-o", str(out), "--photos"]) == 2
    assert "new or empty folder" in capsys.readouterr().err
    assert run(["export", str(folder), "-o", str(out / "a"), "--photos", "--serve"]) == 2
    assert "--serve is for an .html page" in capsys.readouterr().err


def test_what_is_hidden_stays_hidden_in_the_photographs_of_a_tour(tmp_path: Path, write_scene) -> None:
    write_scene(tmp_path / "in" / "hall.jpg", 64)
    hidden = np.zeros((64, 128), np.uint8)
    hidden[28:36, 60:68] = 255
    Image.fromarray(hidden).save(tmp_path / "in" / "hall_blur.png")
    Image.fromarray(255 - hidden).save(tmp_path / "in" / "hall_mask.png")
    assert run(["export", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--photos"]) == 0
    shown, written = (read_panorama(tmp_path / name / "hall.jpg", 64)[0] for name in ("in", "out"))
    assert float((shown - written).abs().max()) < 0.02
    (tmp_path / "in" / "hall_blur.png").unlink()
    original = read_panorama(tmp_path / "in" / "hall.jpg", 64)[0]
    assert float((original - written)[:, 28:36, 60:68].abs().max()) > 0.02, "the file has the blur"
    masks = [np.asarray(Image.open(tmp_path / name / "hall_mask.png").convert("L")) > 127 for name in ("in", "out")]
    assert np.array_equal(*masks)


def test_levels_without_a_preview_count_from_one(export: Export, check_colors) -> None:
    folder = export(_scene("0-hall", levels=LEVELS[1:]), first=1)
    _check_picture(load_panoramas(folder / "data.js")[0], check_colors)


def test_a_level_with_a_damaged_tile_gives_way_to_the_next_complete_one(export: Export, check_colors) -> None:
    folder = export(_scene("0-hall"), _scene("1-attic"))
    for tile in ("0-hall/2/u/1/0", "1-attic/1/f/0/0", "1-attic/2/f/0/0"):
        (folder / f"tiles/{tile}.jpg").write_bytes(b"<html>404</html>")
    with (
        pytest.warns(UserWarning, match="'0-hall' is read at 32 instead of 64 pixels .*2/u/1/0.jpg is damaged"),
        pytest.warns(UserWarning, match="'1-attic' is left out: needed all tiles .*1-attic/2/f/0/0.jpg is damaged"),
    ):
        (hall,) = load_panoramas(folder / "data.js")
    _check_picture(hall, check_colors, 32)


def test_a_broken_start_view_is_dropped(export: Export) -> None:
    views = [{"yaw": {}}, None]
    folder = export(*(_scene(f"{n}-room", initialViewParameters=view) for n, view in enumerate(views)))
    with pytest.warns(UserWarning, match="the start view of 0-room is left out: direction, yaw: needed a number"):
        panoramas = load_panoramas(folder / "data.js")
    assert [panorama.start for panorama in panoramas] == [None, None]


def test_links_to_nowhere_and_to_itself_are_dropped(export: Export) -> None:
    spots = [{"yaw": 1, "pitch": 0, "target": name} for name in ("9-gone", "0-hall")] + [
        {"yaw": "x", "target": "0-hall"}
    ]
    folder = export(_scene("0-hall", linkHotspots=[*spots, None, "x"]))
    with pytest.warns(UserWarning) as caught:
        (hall,) = load_panoramas(folder / "data.js")
    assert hall.links == ()
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == 2
    assert "a link of 0-hall is left out: direction, yaw: needed a number, got 'x'" in messages[0]
    assert "a link of 0-hall is left out: it leads to '9-gone'" in messages[1]


def test_information_is_kept_as_plain_text_with_addresses_of_web_pages(export: Export) -> None:
    text = """<p>Oak &amp; ash<br>1 &lt; 2</p><script>alert(1)</script><img src="img/oven.jpg" onerror="alert(2)">
        <a href="https://example.org/a?b=1&amp;c">more</a>
        <a href="javascript://x/%0Aalert(3)">one</a><a href="data:,x">two</a><a href="https://user name@x">three</a>
        <img alt="a tap" src="http://example.org/tap.png">"""
    spots = [
        {"yaw": 0.5, "pitch": -0.2, "title": "<b>Floor</b>", "text": text},
        {"yaw": 0, "pitch": 0, "title": " ", "text": 7},
        {"yaw": "x", "title": "gone"},
    ]
    with pytest.warns(UserWarning, match="a hot spot of 0-hall is left out: direction, yaw: needed a number"):
        (hall,) = load_panoramas(export(_scene("0-hall", infoHotspots=spots)) / "data.js")
    shown = "Floor\nOak & ash\n1 < 2\n[oven.jpg]\nmore\nonetwothree\n[a tap]"
    assert hall.notes == (Note(0.5, -0.2, shown, ("https://example.org/a?b=1&c", "http://example.org/tap.png")),)


@pytest.mark.parametrize(("name", "title"), [("Our <i>home</i>", "Our <i>home</i>"), ("Project Title", ""), (3, "3")])
def test_the_title_of_the_tour_is_that_of_the_project(export: Export, name: object, title: str) -> None:
    folder = export(_scene("0-hall"), name=name)
    assert [panorama.tour for panorama in load_panoramas(folder / "data.js")] == [title]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"id": None}, 'number 2\' is left out: needed an "id"'),
        ({"levels": None}, "needed all tiles of a level"),
        *(({"id": key}, "needed a file") for key in ("../../etc", "..\\..\\x")),
        ({"levels": [{"size": 64, "tileSize": 0}]}, "tileSize: needed a whole number >= 1, got 0"),
    ],
)
def test_a_broken_scene_is_named_and_the_others_open(export: Export, content: dict, message: str) -> None:
    broken = _scene("1-attic", **content)
    level = [{"tileSize": 4, "size": 4}]
    folder = export(_scene("0-hall", levels=level), first=1)
    (folder / "data.js").write_text(f"APP_DATA = {json.dumps({'scenes': [_scene('0-hall', levels=level), broken, 7]})}")
    with pytest.warns(UserWarning) as caught:
        panoramas = load_panoramas(folder / "data.js")
    assert [panorama.name for panorama in panoramas] == ["0-hall"]
    assert message in str(caught[0].message)
    assert "'number 3' is left out: needed an object, got '7'" in str(caught[1].message)
