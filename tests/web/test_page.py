"""The files of a page, without a browser."""

import base64
import dataclasses
import gzip
import json
import math
import os
import re
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes, urljoin, urlsplit

import numpy as np
import pytest
import shapely
import torch
from refusals import expect_error

from pansplat import pipeline
from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.errors import InputWarning
from pansplat.export import page as page_module
from pansplat.export import page_files, page_scene
from pansplat.export.page import choose_gaussians, write_page
from pansplat.export.plan_files import draw_page_plan
from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.geometry.world import WorldFrame
from pansplat.refinement.budget import merge_to
from pansplat.system.atomic import replacing
from pansplat.tours import edges
from pansplat.tours.facts import TourFacts
from pansplat.tours.floor import find_floor
from pansplat.tours.merge import select_views
from pansplat.tours.outlook import find_bins, measure_clearance, measure_outlook
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.surfaces import find_surfaces


@pytest.fixture(autouse=True)
def no_poor_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edges, "POOR", 9)  # surfaces of the scenes do not agree


def thin(scene: Scene, step: int) -> Scene:
    """The scene with one of `step` Gaussians."""
    kept = torch.arange(0, len(scene.gaussians), step)
    return dataclasses.replace(scene, gaussians=scene.gaussians.select(kept))


def read_header(path: Path) -> dict[str, Any]:
    (header,) = re.findall(r"^const HEADER = (.*);$", path.read_text(), flags=re.MULTILINE)
    return json.loads(header)


def describe(scene: Scene, path: Path, **options: Any) -> dict[str, Any]:
    return read_header(write_page(scene, path, **options).files[0])


def read_start(path: Path) -> list[float]:
    """Yaw and pitch of the first view of a page."""
    header = read_header(path)
    return header["spots"][header["walk"][0]]["ahead"]


def test_the_page_describes_the_scene(scene: Scene, tmp_path: Path) -> None:
    written = write_page(scene, tmp_path / "tour.html")
    header = read_header(tmp_path / "tour.html")
    assert written.files == (tmp_path / "tour.html",)
    assert written.num_bytes == (tmp_path / "tour.html").stat().st_size
    assert written.num_gaussians == header["count"] == len(scene.gaussians) and header["degree"] == 1
    assert [spot["name"] for spot in header["spots"]] == ["room 0", "room 1", "room 2"]
    steps = np.diff([spot["position"] for spot in header["spots"]], axis=0)
    assert np.allclose(steps, np.diff(scene.cam2world[:, :3, 3].numpy(), axis=0), atol=1e-6)
    level = np.array(header["level"])
    assert np.allclose(level @ level.T, np.eye(3), atol=1e-6) and np.linalg.det(level) > 0
    assert np.allclose(level[:, 1], (0, 1, 0), atol=1e-6)  # the cameras are upright: y is down
    for spot, surfaces in zip(header["spots"], find_surfaces(scene, level), strict=True):
        height = find_floor(surfaces.samples)  # rings are on the floor below the cameras
        assert np.array(spot["mark"]) - spot["position"] == pytest.approx((0, height, 0), abs=1e-5)


def test_the_page_of_a_room_has_its_plan_and_what_hides_marks(tmp_path: Path) -> None:
    cameras = make_room_cameras(2)
    room = Scene(full_lattice_room(128), cameras, 0.1, 10.0, names=("west", "east"), height=128)
    header = describe(room, tmp_path / "room.html")
    level, middle = np.array(header["level"]), cameras[:, :3, 3].mean(dim=0).numpy()
    found, (expected,) = header["plan"], TourFacts(room).plan.rooms
    plan = draw_page_plan(TourFacts(room).plan)
    assert found["worlds"] == [0, 0] and b"west / east" in base64.b64decode(plan.drawing)
    assert found["drawing"] == plan.drawing and found["size"] == pytest.approx(plan.size)
    assert np.allclose(level, make_graph(room).level_axes) and np.allclose(found["places"], plan.places)
    c, s = math.cos(found["places"][0][2]), math.sin(found["places"][0][2])
    step = (cameras[1, :3, 3] - cameras[0, :3, 3]).numpy() @ level[:, (0, 2)] @ ((c, -s), (s, c)) * (1, -1)
    assert np.subtract(found["places"][1], found["places"][0])[:2] == pytest.approx(step, abs=1e-5)
    (house,) = header["doll"]
    corners = np.array(house["corners"])
    top = corners[:, 3:].max(axis=1) > 1
    places, normals = (corners[:, :3] @ level)[:, (0, 2)] + level[:, (0, 2)].T @ middle, corners[top, 3:] - 2
    to_wall = shapely.distance(shapely.Polygon(expected.outline).exterior, shapely.points(places[~top]))
    assert house["nodes"] == [0, 1] and to_wall.max() < 1e-3, "all corners of floor and walls are on the outline"
    inward, outward = (
        shapely.contains_xy(shapely.Polygon(expected.outline), *(places[top] + step * normals).T).mean()
        for step in (0.3, -0.3)
    )
    assert inward > outward + 0.4, "normals are in the page's axes"
    assert [[ring["node"] for ring in spot["rings"]] for spot in header["spots"]] == [[1, 0], [0, 1]]


def test_a_page_starts_with_the_widest_view_unless_it_has_a_start_view(house: Scene, tmp_path: Path) -> None:
    """Half of the surfaces around the first camera come close, those ahead."""
    level, gaussians = make_graph(house).level_axes, house.gaussians
    write_page(house, tmp_path / "free.html")
    yaw = read_start(tmp_path / "free.html")[0]
    ahead = torch.from_numpy(level @ (math.sin(yaw), 0, math.cos(yaw))).float()
    offsets = gaussians.means - house.cam2world[0, :3, 3].float()
    close = (gaussians.views == 0) & (offsets @ ahead > 0.3 * offsets.norm(dim=1))
    means = torch.where(close[:, None], house.cam2world[0, :3, 3].float() + 0.2 * offsets, gaussians.means)
    facing = dataclasses.replace(house, gaussians=dataclasses.replace(gaussians, means=means))
    write_page(facing, tmp_path / "wall.html")
    turns = read_header(tmp_path / "wall.html")["spots"][0]["turns"]
    close, away = (turns[find_bins(np.array(angle))] for angle in (yaw, yaw + math.pi))
    assert abs(close) > 0.5 and away == 0, "on arrival, too"
    assert math.cos(read_start(tmp_path / "wall.html")[0] - yaw) < 0
    local = house.cam2world[0, :3, :3].numpy().T @ ahead.numpy()
    start = math.atan2(local[0], local[2]), math.asin(local[1])
    write_page(dataclasses.replace(facing, starts=(start, None, None)), tmp_path / "start.html")
    assert math.cos(read_start(tmp_path / "start.html")[0] - yaw) == pytest.approx(1, abs=1e-5)


def test_without_a_floor_there_is_no_dolls_house_and_no_outline(scene: Scene, tmp_path: Path) -> None:
    centers = scene.cam2world[scene.gaussians.views.long(), :3, 3].float()
    above = scene.gaussians.select(scene.gaussians.means[:, 1] < centers[:, 1])
    write_page(scene, tmp_path / "floor.html")
    page = write_page(dataclasses.replace(scene, gaussians=above), tmp_path / "none.html")
    headers = [read_header(tmp_path / f"{name}.html") for name in ("floor", "none")]
    assert headers[1]["doll"] == [] and page.num_outside == 3
    assert 'id="atlas"' not in (tmp_path / "none.html").read_text()
    assert headers[1]["plan"]["worlds"] == [0, 0, 0] and len(headers[1]["plan"]["places"]) == 3


def test_panoramas_on_both_sides_of_a_wall_have_links(flat: Scene, tmp_path: Path) -> None:
    """The nearest ones of two parts without a link; others have that of their tour."""
    walls = tuple((node, alone, 0.0) for alone in (2, 3) for node in (0, 1))
    tour = SceneTour((*flat.tour.overlaps, *walls), flat.tour.links)
    header = describe(dataclasses.replace(flat, tour=tour), tmp_path / "page.html")
    spots, level = header["spots"], np.array(header["level"])
    places = np.array([spot["position"] for spot in spots])
    near = int(np.linalg.norm(places[:2] - places[3], axis=1).argmin())
    assert [(link["from"], link["to"]) for link in header["links"]] == [(0, 2), *sorted([(near, 3), (2, 0)]), (3, near)]
    for link in header["links"]:
        if 3 in (link["from"], link["to"]):
            right, _, ahead = level.T @ (places[link["to"]] - places[link["from"]])
            assert math.cos(link["yaw"] - math.atan2(right, ahead)) == pytest.approx(1, abs=1e-6)
            assert any(ring["node"] == link["to"] and ring["mark"] for ring in spots[link["from"]]["rings"])


def test_a_page_zooms_along_poor_edges(house: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = write_page(house, tmp_path / "good.html")
    assert (good.num_flights, good.zooms) == (2, ())
    monkeypatch.setattr(edges, "POOR", -9)
    poor = write_page(house, tmp_path / "poor.html")
    header = read_header(tmp_path / "poor.html")
    assert (poor.num_flights, len(poor.zooms)) == (0, 2) and header["poor"] == [[0, 1], [1, 2]]
    assert poor.zooms == tuple(zip(house.names[:2], house.names[1:], strict=True)), "the labels"
    assert set(header["parts"]) == {0} and header["walk"] == [0, 1, 2]
    joint = dataclasses.replace(house, joint=True, tour=None)
    assert write_page(joint, tmp_path / "joint.html").zooms == ()


def test_the_page_of_a_tour_has_its_edges_and_its_walk(house: Scene, tmp_path: Path) -> None:
    header = describe(dataclasses.replace(house, names=("hall", "hall", "bath")), tmp_path / "tour.html")
    assert [spot["name"] for spot in header["spots"]] == ["hall", "hall", "bath"], "rooms of poses.json"
    assert header["groups"] == [[0, 1], [1, 2]] and header["edges"] == [[0, 1, 0], [1, 2, 1]]
    assert header["next"] == [[0, 1, 1], [0, 1, 2], [1, 1, 2]]
    assert header["walk"] == [0, 1, 2]


def test_the_page_of_a_tour_of_parts_has_links(flat: Scene, tmp_path: Path) -> None:
    header = describe(flat, tmp_path / "tour.html")
    assert header["parts"] == [0, 0, 1, 2] and header["edges"] == [[0, 1, 0], [2, 2, 1], [3, 3, 2]]
    assert header["groups"] == [[0, 1], [2], [3]]
    spots, level = header["spots"], np.array(header["level"])
    assert spots[0]["ahead"] == [0.3, -0.2]
    assert spots[3]["ahead"] == pytest.approx([1.0 + 3 * 0.7, 0.2], abs=1e-5) and spots[1]["ahead"][1] == 0
    assert [spot["hasStart"] for spot in spots] == [True, False, False, True]
    np.testing.assert_allclose(spots[1]["clearances"], measure_clearance(find_surfaces(flat, level)[1]), atol=0.0051)
    to, back = header["links"]
    assert (to["from"], to["to"], to["text"]) == (0, 2, "<i>down") and (back["from"], back["to"]) == (2, 0)
    assert (to["yaw"], back["yaw"]) == pytest.approx((0.5 * np.pi, 2 * 0.7), abs=1e-4) and to["pitch"] == -0.6
    (ring,) = (ring for ring in spots[0]["rings"] if ring["mark"])
    assert ring["node"] == 2
    right, down, ahead = level.T @ np.subtract(ring["mark"], spots[0]["position"])
    assert down == pytest.approx(level.T[1] @ np.subtract(spots[0]["mark"], spots[0]["position"]), abs=1e-5)
    wall = measure_outlook(find_surfaces(flat, level)[0])[find_bins(np.array(0.5 * math.pi))]
    assert (right, ahead) == pytest.approx((max(down / np.tan(0.6), 1), 0), rel=0.01, abs=1e-5) and right < wall
    assert header["limits"] == pytest.approx([2.0, 1.0, 1.0]), "the part with two views, and single views"
    assert sorted(header["walk"]) == [0, 1, 2, 3] and header["walk"][0] == 0


def test_a_page_with_photographs_has_gaussians_only_where_a_camera_flies(flat, tmp_path, take_photographs) -> None:
    photographs = take_photographs(flat, 64)
    header = describe(flat, tmp_path / "tour.html", photographs=photographs)
    assert [view["count"] > 0 for view in header["views"]] == [True, True, False, False]
    assert header["limits"] == [pytest.approx(2.0), 0, 0] and header["loading"] == [0, 1, 2, 3]
    alone = dataclasses.replace(flat, tour=SceneTour(tuple((node, node, 1.0) for node in range(4)), flat.tour.links))
    written = write_page(alone, tmp_path / "alone.html", photographs=photographs)
    assert written.num_gaussians == 0 and read_header(tmp_path / "alone.html")["limits"] == [0] * 4


@pytest.mark.parametrize(("size", "limit"), [(1.0, 1.0), (0.5, 0.62)])
def test_the_camera_stays_within_a_metre_of_a_single_photograph(scene, tmp_path, size: float, limit: float) -> None:
    single = select_views(scene, (1,))  # its surfaces are 2 to 3 m away
    center = single.cam2world[0, :3, 3].float()
    gaussians = dataclasses.replace(single.gaussians, means=center + size * (single.gaussians.means - center))
    header = describe(dataclasses.replace(single, gaussians=gaussians, starts=((0.4, 0.1),)), tmp_path / "page.html")
    assert header["limits"] == pytest.approx([limit], abs=0.01)
    assert header["spots"][0]["ahead"] == pytest.approx([0.4, -0.1], abs=1e-4)


def test_panoramas_of_all_parts_that_have_gaussians_keep_as_many(flat: Scene) -> None:
    without = dataclasses.replace(flat, gaussians=flat.gaussians.select(flat.gaussians.views != 2))
    for scene, count, third in ((flat, 800, 200), (without, 600, 0)):
        merged = page_scene.merge(scene, (0, 0, 1, 2), count, steps=0)
        counts = np.bincount(merged.gaussians.views.numpy())
        assert counts[0] + counts[1] == 400 and counts[2] == third and counts[3] == 200
        assert torch.equal(merged.cam2world, flat.cam2world)


def test_gaussians_leave_bytes_to_photographs_that_need_them() -> None:
    assert [choose_gaussians(heights) for heights in ([], [1024] * 5, [4096] * 5)] == [600_000, 450_000, 300_000]
    assert 300_000 < choose_gaussians([2048] * 4) < 450_000


def test_the_page_loads_nothing_from_elsewhere(scene: Scene, tmp_path: Path) -> None:
    write_page(scene, tmp_path / "tour.html")
    text = (tmp_path / "tour.html").read_text()
    assert "default-src 'none'" in text
    assert not re.findall(r"""(?:src|href)=["'](?!data:)|https?://|@import|url\(""", text)


def test_a_page_has_at_most_the_given_number_of_gaussians(scene: Scene, tmp_path: Path) -> None:
    written = write_page(scene, tmp_path / "tour.html", gaussians=800)
    header = read_header(tmp_path / "tour.html")
    assert 500 < written.num_gaussians <= 800
    assert sum(view["count"] for view in header["views"]) == header["count"] == written.num_gaussians


@pytest.mark.parametrize("fixture", ["plain_scene", "scene"])
def test_colours_of_merged_gaussians_are_fitted_to_all(request: pytest.FixtureRequest, fixture: str) -> None:
    full = request.getfixturevalue(fixture)
    size, pose = (32, 64), full.cam2world[0]
    needed = pipeline.render(full, pose, size=size, blend=0).color
    errors = [
        float((pipeline.render(scene, pose, size=size, blend=0).color - needed).square().mean())
        for scene in (page_scene.merge(full, (0,) * len(full.cam2world), 700), merge_to(full, (64, 128), 700))
    ]
    assert errors[0] < 0.8 * errors[1]


def _make_beams(count: int = 12_000, rows: int = 48) -> Scene:
    """Flat Gaussians on a sphere of 3 m, light with narrow dark bands that cross the lattice at an angle."""
    directions = fibonacci_directions(count).float()
    longitudes = torch.atan2(directions[:, 0], directions[:, 2])
    colors = torch.where(torch.sin(5 * longitudes + 4 * directions[:, 1]) > 0.85, 0.1, 0.9)[:, None].expand(-1, 3)
    scale, labels = 1.8 * math.sqrt(4 * math.pi / count), torch.zeros(count, dtype=torch.uint8)
    gaussians = Gaussians(
        means=3 * directions,
        scales=torch.tensor((scale, scale, 0.01)).repeat(count, 1),
        quats=torch.cat((1 + directions[:, 2:], -directions[:, 1:2], directions[:, :1], torch.zeros(count, 1)), dim=1),
        opacities=torch.full((count,), 0.9),
        harmonics=((colors - 0.5) / SH_0)[:, None],
        levels=labels,
        views=labels,
    )
    return Scene(gaussians, torch.eye(4, dtype=torch.float64)[None], 0.5, 10.0, ("camera",), height=rows)


def _measure_dots(scene: Scene, full: Scene) -> float:
    """Energy of the difference of two scenes' images above the sampling limit of the scene's rows, relative to the
    energy there of the full scene's image, near the horizon at four times the rows."""
    rows = 4 * full.height
    window = torch.hann_window(rows // 2, periodic=False, dtype=torch.float64)[:, None]

    def transform(shown: Scene) -> torch.Tensor:
        image = pipeline.render(shown, full.cam2world[0], size=(rows, 2 * rows)).color.double()
        return torch.fft.fft2(window * image[:, rows // 4 : 3 * rows // 4])

    merged, needed = transform(scene), transform(full)
    down, right = (torch.fft.fftfreq(n).abs() for n in needed.shape[1:])
    is_above = torch.maximum(down[:, None], right[None]) > 0.5 * full.height / rows
    errors, energies = (values[:, is_above].abs().square().sum() for values in (merged - needed, needed))
    return float(errors / energies)


def test_merged_gaussians_are_lines_and_not_dots_in_large_images(monkeypatch: pytest.MonkeyPatch) -> None:
    full = _make_beams()
    assert _measure_dots(page_scene.merge(full, (0,), 3000, steps=0), full) > 2  # colours alone
    assert _measure_dots(page_scene.merge(full, (0,), 3000), full) < 1
    monkeypatch.setattr(page_scene, "DISPLAY_HEIGHT", full.height)  # fitted at the scene's own rows
    assert _measure_dots(page_scene.merge(full, (0,), 3000), full) > 1.2


def test_merged_gaussians_of_a_scene_whose_views_are_unknown_keep_their_image(plain_scene: Scene) -> None:
    foreign = dataclasses.replace(
        plain_scene, gaussians=dataclasses.replace(plain_scene.gaussians, views=7 + plain_scene.gaussians.views)
    )
    full = page_scene.prepare(foreign)
    merged = page_scene.merge(full, (0, 0), 700)
    for pose in full.cam2world:  # the second camera has no Gaussians of its own
        images = [pipeline.render(scene, pose, blend="joint", size=(32, 64)).color for scene in (full, merged)]
        assert float((images[1] - images[0]).abs().mean()) < 0.05


@pytest.mark.parametrize(
    ("address", "base"), [(None, ""), ("https://a.b/home", "https://a.b/home/"), ("https://a.b/t.html", "https://a.b/")]
)
def test_a_folder_has_what_previews_of_links_show(plain_scene, tmp_path, address: str | None, base: str) -> None:
    page = write_page(plain_scene, tmp_path / "index.html", split=True, title='My "home"', address=address)
    found = dict(re.findall(r'<meta (?:name|property)="(.*?)" content="(.*?)">', page.files[0].read_text()))
    assert found["og:title"] == "My &quot;home&quot;"
    assert found["description"] == found["og:description"] == "2 panoramas: room 0, room 1"
    (preview,) = (tmp_path / "index_files").glob("preview_*.jpg")
    assert found["og:image"] == f"{base}index_files/{preview.name}" and preview in page.files
    assert {file.name[:7] for file in page.files if file.suffix == ".bin"} == {"room-0_", "room-1_"}


def test_a_title_cannot_leave_its_element(scene: Scene, tmp_path: Path) -> None:
    evil = dataclasses.replace(scene, names=("</script><script>alert(1)</script>", "<!--", "c"))
    write_page(evil, tmp_path / "tour.html", title="<b>&</title>")
    text = (tmp_path / "tour.html").read_text()
    assert "<b>" not in text and "alert(1)</script>" not in text and "<!--" not in text
    assert read_header(tmp_path / "tour.html")["spots"][1]["name"] == "<!--"


def test_the_parts_of_a_split_page_replace_the_old_ones(scene: Scene, tmp_path: Path) -> None:
    other = tmp_path / "tour_files" / "other.js"
    first = write_page(scene, tmp_path / "tour.html", split=True)
    other.write_text("")
    assert len(first.files) > 2 and all(file.stat().st_size for file in first.files)
    assert first.num_bytes == sum(file.stat().st_size for file in first.files)
    second = write_page(thin(scene, 2), tmp_path / "tour.html", split=True)
    text = (tmp_path / "tour.html").read_text()
    assert set((tmp_path / "tour_files").iterdir()) == {*second.files[1:], other}
    header = read_header(tmp_path / "tour.html")
    assert header["folder"] == "tour_files" and "<script src" not in text, "they are loaded when they are needed"
    assert [name for view in header["views"] for name in view["files"]] == [file.name for file in second.files[1:-1]]
    assert {file.suffix for file in second.files[1:-1]} == {".bin"} and "connect-src 'self'" in text
    assert sum(len(gzip.decompress(file.read_bytes())) for file in second.files[1:-1]) % header["count"] == 0


def test_a_page_in_one_file_removes_the_parts_of_the_split_one_before_but_no_file_of_the_user(scene, tmp_path) -> None:
    write_page(scene, tmp_path / "tour.html", split=True)
    other = tmp_path / "tour_files" / "0123456789abcdef.bin"
    other.write_text("mine")
    write_page(scene, tmp_path / "tour.html")
    assert {file for file in tmp_path.rglob("*") if file.is_file()} == {tmp_path / "tour.html", other}


@pytest.mark.parametrize("at", ["first part", "last part"])
def test_an_export_that_ends_during_another_one_removes_none_of_its_parts(scene, tmp_path, monkeypatch, at) -> None:
    path, counts = tmp_path / "tour.html", []
    write_page(scene, path, split=True)

    @contextmanager
    def interrupted(file: Path) -> Iterator[Path]:
        with replacing(file) as temporary:
            yield temporary
        counts.append(file.suffix)
        if file.suffix == ".bin" and counts.count(".bin") == (1 if at == "first part" else 3):
            monkeypatch.setattr(page_files, "replacing", replacing)
            write_page(thin(scene, 3), path, split=True)

    monkeypatch.setattr(page_files, "replacing", interrupted)
    for step in (2, 1):  # other parts than before, and the same
        counts.clear()
        last = write_page(thin(scene, step), path, split=True)
        assert set((tmp_path / "tour_files").iterdir()) == set(last.files[1:])
        monkeypatch.setattr(page_files, "replacing", interrupted)


def test_the_parts_of_a_copy_of_a_page_stay(scene: Scene, tmp_path: Path) -> None:
    first = write_page(scene, tmp_path / "tour.html", split=True)
    shutil.copy(first.files[0], tmp_path / "copy.html")
    second = write_page(thin(scene, 2), tmp_path / "tour.html", split=True)
    assert set((tmp_path / "tour_files").iterdir()) == {*first.files[1:], *second.files[1:]}
    (tmp_path / "copy.html").unlink()
    write_page(scene, tmp_path / "tour.html")
    assert list(tmp_path.iterdir()) == [tmp_path / "tour.html"]


@pytest.mark.parametrize("stem", ["room #2", "50%25 done?", "a:b & 'c'", "k\xfcche", os.fsdecode(b"caf\xe9")])
def test_a_split_page_finds_its_parts_under_any_name(scene: Scene, tmp_path: Path, stem: str) -> None:
    written = write_page(scene, tmp_path / f"{stem}.html", split=True)
    header = read_header(written.files[0])
    for view, file in zip(header["views"], written.files[1:-1], strict=True):  # one for each view, and the preview
        place = urlsplit(urljoin("file:///folder/page.html", f"{header['folder']}/{view['files'][0]}"))
        assert not place.query and not place.fragment
        assert unquote_to_bytes(place.path) == b"/folder/" + os.fsencode(f"{stem}_files/{file.name}")


def test_the_smallest_photograph_of_the_first_panorama_comes_before_all_gaussians(scene, take_photographs, tmp_path):
    header = describe(scene, tmp_path / "tour.html", photographs=take_photographs(scene, 1024))
    first, *others = header["loading"]
    names = [photograph["name"] for photograph in header["photographs"]]
    calls = re.findall(r"<script>(add\w+\([^<]*\))</script>", (tmp_path / "tour.html").read_text())
    early = [f'addTile("{names[first]}", 0)', f"addChunk({first}, true)", f'addTile("{names[first]}", 6)']
    assert calls[:3] == early and calls[3:5] == [f"addChunk({view}, true)" for view in others]
    assert calls[5:] == [f'addTile("{names[view]}", {number})' for view in others for number in (0, 6)]


def test_a_scene_without_cameras_starts_in_its_middle(scene: Scene, tmp_path: Path) -> None:
    bare = dataclasses.replace(scene, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64), names=())
    header = describe(bare, tmp_path / "tour.html", gaussians=1000)
    assert len(header["views"]) == 1 and header["views"][0]["count"] == header["count"] <= 1000
    assert header["spots"][0]["name"] == "start" and np.allclose(header["spots"][0]["position"], 0)


def test_gaussians_that_cannot_be_drawn_are_left_out(scene: Scene, tmp_path: Path) -> None:
    means, opacities = scene.gaussians.means.clone(), scene.gaussians.opacities.clone()
    means[0], means[1], opacities[2] = torch.nan, 1e35, 0.001
    broken = dataclasses.replace(scene.gaussians, means=means, opacities=opacities)
    written = write_page(dataclasses.replace(scene, gaussians=broken), tmp_path / "tour.html")
    assert written.num_gaussians == len(scene.gaussians) - 3


def test_large_pages_have_a_lower_degree_of_harmonics(scene, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(page_module, "_TARGET_BYTES", 32 * len(scene.gaussians))
    assert describe(scene, tmp_path / "tour.html")["degree"] == 0


def test_a_page_of_another_unit_is_that_of_metres_but_for_the_lengths_it_shows(flat: Scene, tmp_path: Path) -> None:
    headers = []
    for name, unit in (("metres", 1.0), ("millimetres", 1e3), ("kilometres", 1e-3)):
        write_page(dataclasses.replace(flat, frame=WorldFrame(unit)), tmp_path / f"{name}.html", split=True)
        headers.append(read_header(tmp_path / f"{name}.html") | {"folder": ""})
    assert [header.pop("unit") for header in headers] == pytest.approx([1.0, 1e-3, 1e3])
    assert headers[0] == headers[1] == headers[2], "the names of the files have the hash of what they hold"


def test_pages_that_cannot_be_drawn_or_written_are_refused(scene, tmp_path, monkeypatch) -> None:
    empty = dataclasses.replace(scene, gaussians=scene.gaussians.select(torch.arange(0)))
    monkeypatch.setattr(page_files, "MAX_FILE_BYTES", 60_000)
    for given, name, options, message in (
        (empty, "tour.html", {}, "no visible Gaussians"),
        (scene, "tour.html", {}, r"write a folder.*at most [\d,]+ Gaussians"),
        (scene, "tour.html", {"gaussians": 0}, "must be 1 to 4,000,000"),
        (scene, "tour.html", {"gaussians": 4_000_001}, "must be 1 to 4,000,000"),
        (scene, "missing/tour.html", {"split": True}, "missing/tour_files: needed a folder"),
    ):
        expect_error(message, write_page, given, tmp_path / name, **options)
    assert not list(tmp_path.iterdir())
    (tmp_path / "tour_files").write_text("")
    expect_error("tour_files: needed a folder", write_page, scene, tmp_path / "tour.html", split=True)
    monkeypatch.undo()
    monkeypatch.setattr(page_module, "_POSTER_SIZE", (27, 32))
    expect_error("existing folder", write_page, scene, tmp_path / "missing" / "tour.html")
    assert [file.name for file in tmp_path.iterdir()] == ["tour_files"]


def test_the_page_of_a_fused_tour_draws_all_gaussians_everywhere(house: Scene, tmp_path: Path) -> None:
    fused = dataclasses.replace(house, joint=True)
    with pytest.warns(InputWarning, match="Export the folder of the photographs"):
        header = describe(fused, tmp_path / "house.html")
    assert header["edges"] == [[0, 1, 0], [0, 2, 0], [1, 2, 0]] and header["groups"] == [[0, 1, 2]]
    assert header["count"] == len(house.gaussians)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_page(dataclasses.replace(fused, tour=None), tmp_path / "pair.html")
