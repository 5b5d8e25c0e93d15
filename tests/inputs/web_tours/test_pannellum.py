"""Tours of Pannellum open with their pictures, titles, links and start views, whatever else is broken."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pansplat.images.image_files import read_height, read_panorama
from pansplat.inputs.folders import load_panoramas
from pansplat.inputs.panorama_sets import Link, Note
from pansplat.inputs.web_tours import find_web_tours

MULTIRES = {
    "basePath": "tiles",
    "path": "/%l/%s%y_%x",
    "fallbackPath": "/fallback/%s",
    "extension": "jpg",
    "tileResolution": 16,
    "maxLevel": 3,
    "cubeResolution": 40,
}


def _write(folder: Path, content: Any, name: str = "tour.json") -> Path:
    (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))
    return folder / name


@pytest.fixture
def multires(tmp_path: Path, write_tiles) -> Path:
    """Tiles of three levels as generate.py of Pannellum makes them, with fallback; returns the folder."""
    for level, size in ((1, 10), (2, 20), (3, 40)):
        write_tiles(size, 16, lambda face, row, column, n=level: tmp_path / f"tiles/{n}/{face}{row}_{column}.jpg")
    write_tiles(24, 24, lambda face, row, column: tmp_path / f"tiles/fallback/{face}.jpg")
    return tmp_path


def test_a_tour_of_panoramas_has_titles_links_and_start_views(tmp_path: Path, write_scene, check_colors) -> None:
    write_scene(tmp_path / "img/hall.jpg")
    write_scene(tmp_path / "img/my kitchen.jpg", turn=5)
    spots = [
        {"type": "scene", "pitch": -10, "yaw": 90, "sceneId": "hall", "text": "Hall", "targetYaw": 5},
        {"type": "info", "pitch": 10, "yaw": 90, "text": "a <b>lamp", "URL": "https://example.org"},
        {"type": "info", "yaw": 0, "image": "img/lamp.png", "URL": "javascript:alert(1)"},
    ]
    content = {
        "default": {"firstScene": "hall", "basePath": "img/", "yaw": 20},
        "title": "Our home",
        "scenes": {
            "kitchen": {"panorama": "my%20kitchen.jpg?v=2", "hotSpots": spots, "pitch": 30},
            "hall": {"title": "The hall", "type": "equirectangular", "panorama": "hall.jpg", "yaw": -190},
        },
    }
    hall, kitchen = load_panoramas(_write(tmp_path, content))
    assert hall.tour == kitchen.tour == "Our home" and hall.notes == ()
    lamp, picture = kitchen.notes
    assert (lamp.yaw, lamp.pitch) == pytest.approx((math.pi / 2, -math.radians(10)))
    assert (lamp.text, lamp.addresses) == ("a <b>lamp", ("https://example.org",))
    assert picture == Note(0, 0, "[lamp.png]")
    assert (hall.name, hall.label, kitchen.label) == ("hall", "The hall", "kitchen")
    assert hall.image == tmp_path / "img/hall.jpg" and kitchen.image == tmp_path / "img/my kitchen.jpg"
    (link,) = kitchen.links
    assert (link.target, link.text) == ("hall", "Hall")
    assert (link.yaw, link.pitch) == pytest.approx((math.pi / 2, math.radians(10)))
    assert hall.start == pytest.approx((math.radians(170), 0))
    assert kitchen.start == pytest.approx((math.radians(20), math.radians(-30)))
    check_colors(read_panorama(hall.image, 32)[0])


def test_tiles_of_several_levels_are_one_panorama(multires: Path, check_colors) -> None:
    (panorama,) = load_panoramas(_write(multires, {"type": "multires", "multiRes": MULTIRES}, "config.json"))
    assert read_height(panorama.image) == 80
    for height in (80, 40, 16):
        check_colors(read_panorama(panorama.image, height)[0])


def test_six_files_are_one_panorama(tmp_path: Path, color_face, check_colors) -> None:
    files = []
    for number, face in enumerate("frblud"):
        files.append(f"examplepanocube{number}.png")
        Image.fromarray(color_face(face, 32)).save(tmp_path / files[-1])
    (panorama,) = load_panoramas(_write(tmp_path, {"type": "cubemap", "cubeMap": files}))
    assert panorama.name == tmp_path.name.replace("[", "_").replace("]", "_")[:60].strip("_.")
    check_colors(read_panorama(panorama.image, 64)[0])


HTML = """<!DOCTYPE HTML><html><head><script src="pannellum.js"></script></head><body><div id="panorama"></div>
<script>
%s
document.getElementById('x').onclick = () => { run(); };
</script></body></html>"""


@pytest.mark.parametrize(
    "script",
    [
        "pannellum.viewer('panorama', {type: 'equirectangular', /* why */ 'panorama': \"hall.jpg\", autoLoad: true,});",
        "v = pannellum.viewer(document.getElementById('p'), { panorama: b ? 1 : 2, panorama: 'hall.jpg', f() {} })",
    ],
)
def test_a_configuration_in_a_page_is_read_and_not_run(tmp_path: Path, script: str, write_scene) -> None:
    write_scene(tmp_path / "hall.jpg")
    page = _write(tmp_path, HTML % script, "page.html")
    assert find_web_tours(tmp_path) == [page]
    assert [panorama.image.name for panorama in load_panoramas(page)] == ["hall.jpg"]


def test_damaged_pictures_are_left_out_and_damaged_tiles_give_way(multires: Path, write_scene, check_colors) -> None:
    write_scene(multires / "attic.jpg")
    for name in ("tiles/3/d2_1.jpg", "attic.jpg"):
        (multires / name).write_bytes((multires / name).read_bytes()[:-20])
    scenes = {"hall": {"type": "multires", "multiRes": MULTIRES}, "attic": {"panorama": "attic.jpg"}}
    with (
        pytest.warns(UserWarning, match=r"is read at 20 instead of 40 pixels a face: .*d2_1\.jpg is damaged"),
        pytest.warns(UserWarning, match=r"'attic' is left out: .*attic\.jpg: needed a complete image"),
    ):
        (panorama,) = load_panoramas(_write(multires, {"scenes": scenes}))
    check_colors(read_panorama(panorama.image, 40)[0])


def test_without_tiles_the_fallback_is_read(multires: Path, check_colors) -> None:
    for level in "123":
        (multires / f"tiles/{level}/f0_0.jpg").unlink()
    with pytest.warns(UserWarning, match="read at 24 instead of 40 pixels"):
        (panorama,) = load_panoramas(_write(multires, {"type": "multires", "multiRes": MULTIRES}))
    check_colors(read_panorama(panorama.image, 48)[0])


def test_the_same_picture_in_two_scenes_is_one_panorama(tmp_path: Path, write_scene) -> None:
    for name in "ab":
        write_scene(tmp_path / f"{name}.jpg")
    link = {"hotSpots": [{"sceneId": "day", "yaw": 0, "pitch": 0}]}
    scenes = {"night": {"panorama": "a.jpg"}, "day": {"panorama": "a.jpg"}, "hall": {"panorama": "b.jpg", **link}}
    night, hall = load_panoramas(_write(tmp_path, {"scenes": scenes}))
    assert (night.name, hall.links) == ("night", (Link("night", 0.0, 0.0),))
    assert str(hall.links[0].pitch) == "0.0", "not -0.0, which would be in links.json"


def test_names_are_file_safe_and_unique(tmp_path: Path, write_scene) -> None:
    keys = ["a/b", "a b", "A_B", "..", "\u00e9t\u00e9"]
    for number in range(len(keys)):
        write_scene(tmp_path / f"{number}.jpg")
    scenes = {key: {"panorama": f"{number}.jpg"} for number, key in enumerate(keys)}
    names = [panorama.name for panorama in load_panoramas(_write(tmp_path, {"scenes": scenes}))]
    assert names == ["a_b", "a_b_2", "A_B_3", "scene_4", "\u00e9t\u00e9"]


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ({"panorama": "gone.jpg"}, "gone.jpg"),
        ({"panorama": "https://example.org/a.jpg"}, "https://example.org/a.jpg"),
        ({"panorama": "//example.org/a.jpg"}, "//example.org/a.jpg"),
        ({"panorama": "../../etc/passwd"}, "/etc/passwd"),
        ({"panorama": "%2e%2e/x.jpg"}, "../x.jpg"),
        ({"panorama": "hall.jpg", "haov": 120}, "120 x 180"),
        ({"panorama": "hall.jpg", "dynamic": True}, "a video"),
        ({"panorama": "photo.jpg"}, "photo.jpg: needed a 2:1"),
        ({"panorama": "text.jpg"}, "text.jpg"),
        ({"type": "fisheye", "panorama": "hall.jpg"}, "'fisheye'"),
        ({"type": "cubemap", "cubeMap": ["a.jpg"] * 5}, '"cubeMap"'),
        ({"type": "multires", "multiRes": MULTIRES}, "tiles/3/f0_0.jpg is missing"),
        ({"type": "multires", "multiRes": MULTIRES | {"maxLevel": 99}}, "maxLevel"),
        ({"type": "multires", "multiRes": MULTIRES | {"path": "/x"}}, "%s"),
        ({"type": "multires", "multiRes": MULTIRES | {"basePath": "../.."}}, "../.."),
    ],
)
def test_a_broken_scene_is_named_and_the_others_open(tmp_path: Path, scene: object, message: str, write_scene) -> None:
    write_scene(tmp_path / "hall.jpg")
    Image.new("RGB", (30, 30)).save(tmp_path / "photo.jpg")
    (tmp_path / "text.jpg").write_text("hello")
    scenes = {"attic": scene, "hall": {"panorama": "hall.jpg"}}
    with pytest.warns(UserWarning) as caught:
        panoramas = load_panoramas(_write(tmp_path, {"scenes": scenes}))
    assert [panorama.name for panorama in panoramas] == ["hall"]
    assert "scene 'attic' is left out" in str(caught[0].message) and message in str(caught[0].message)


def test_json_files_of_other_kinds_are_no_tours(tmp_path: Path) -> None:
    for name, text in (
        ("poses.json", '{"panorama": "x.jpg"}'),
        ("a.json", '{"version": 1}'),
        ("b.json", '{"panorama'),
        ("c.html", "<p>"),
    ):
        _write(tmp_path, text, name)
    assert find_web_tours(tmp_path) == []
