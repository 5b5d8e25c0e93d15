"""`pansplat pose` replaces nothing that it did not write, and uses what a folder states."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pansplat
from pansplat.cli import run
from pansplat.cli.batch import Batch, fingerprint_work, process_item
from pansplat.errors import InputError
from pansplat.images.image_files import write_image
from pansplat.poses.estimate import NoPosesError, PoseEstimate, PoseGroup
from pansplat.poses.two_view import RelativePose
from pansplat.prediction_options import PredictOptions, ReadOptions
from pansplat.system.store import Store
from pansplat_viewer import run as run_viewer
from pansplat_viewer.core.loader import find_entries

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

SPHERE = PredictOptions("sphere", height=64, refine_steps=0, cache=False)


def _photograph(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (64, 128, 3), np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number, name in enumerate("ab"):
        Image.fromarray(_photograph(number)).save(tmp_path / f"{name}.png")
    return tmp_path


def _refuse(*args, **options) -> PoseEstimate:
    raise AssertionError("nothing may be estimated")


def _place_two(images, **options) -> PoseEstimate:
    poses = {image: np.eye(4) for image in images[:2]}
    poses[images[1]][0, 3] = 1
    rest = dict.fromkeys(images[2:], "no door")
    return PoseEstimate(tuple(images), (PoseGroup(poses, 0.4, 8.0, 0.0, "a test"),), rest, {})


@pytest.fixture
def estimator(monkeypatch):
    """Sets the function that estimates poses."""
    return lambda function: monkeypatch.setattr("pansplat.poses.files.estimate_poses", function)


def test_measured_poses_are_an_error_before_the_estimate_and_replaced_with_overwrite(folder, estimator, capsys) -> None:
    file = folder / "poses.json"
    poses = {f"{each}.png": np.eye(4).tolist() for each in "ab"}
    file.write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    before = file.read_bytes()
    estimator(_refuse)
    assert run(["pose", str(folder), "-o", str(file)]) == 2
    error = capsys.readouterr().err
    assert "poses.json" in error and "--overwrite" in error and file.read_bytes() == before
    estimator(_place_two)
    assert run(["pose", str(folder), "-o", str(file), "--overwrite"]) == 0
    assert json.loads(file.read_text())["poses"]["b.png"][0][3] == 1
    assert (folder / "poses.json.bak").read_bytes() == before
    file.write_text("[")
    estimator(_refuse)
    assert run(["pose", str(folder), "-o", str(file), "--overwrite"]) == 2
    assert "poses.json: needed JSON" in capsys.readouterr().err and file.read_text() == "["


def test_renderings_beside_photographs_are_given_no_poses(folder: Path, estimator, capsys) -> None:
    write_image(folder / "0_view.png", np.zeros((16, 32, 3), np.uint8))
    estimator(_place_two)
    assert run(["pose", str(folder), "-o", str(folder / "poses.json")]) == 0
    assert list(json.loads((folder / "poses.json").read_text())["poses"]) == ["a.png", "b.png"]
    assert "0_view.png: it was rendered by pansplat" in capsys.readouterr().err


@pytest.fixture(params=["a folder with links", "a web tour of pictures", "a web tour of cube faces"])
def linked(request: pytest.FixtureRequest, folder: Path, write_tiles) -> Path:
    """Three panoramas, of which the first one links to the second."""
    Image.fromarray(_photograph(2)).save(folder / "c.png")
    if request.param == "a folder with links":
        entry = {"title": "Hall", "links": [{"to": "b.png", "yaw": 1.5}]}
        (folder / "links.json").write_text(json.dumps({"a.png": entry}))
        return folder
    tour = folder / "tour"
    tour.mkdir()
    if request.param == "a web tour of pictures":
        (tour / "img").mkdir()
        for name in "abc":
            (folder / f"{name}.png").rename(tour / "img" / f"{name}.png")
        spots = [{"type": "scene", "yaw": 90, "sceneId": "b"}]
        scenes = {name: {"panorama": f"img/{name}.png", "hotSpots": spots if name == "a" else []} for name in "abc"}
        (tour / "tour.json").write_text(json.dumps({"scenes": scenes}))
        return tour
    scenes = []
    for name in "abc":
        base = tour / "tiles" / name
        write_tiles(32, 32, lambda face, row, column, base=base: base / "1" / face / str(row) / f"{column}.jpg")
        links = [{"yaw": 1.5, "pitch": 0, "target": "b"}] if name == "a" else []
        levels = [{"tileSize": 32, "size": 32}]
        scenes.append({"id": name, "name": f"Room {name}", "levels": levels, "faceSize": 32, "linkHotspots": links})
    (tour / "data.js").write_text(f"var APP_DATA = {json.dumps({'scenes': scenes, 'name': 'Flat'})};")
    (tour / "index.html").write_text("<script src='data.js'></script>")
    for name in "abc":  # tiles of one scene look like those of another one
        Image.fromarray(_photograph(ord(name))[:32, :32]).save(tour / "tiles" / name / "1" / "f" / "0" / "0.jpg")
    return tour


CALLERS = {
    "pose": lambda folder, out: run(["pose", str(folder), "-o", str(folder / "poses.json")]),
    "pose of a tour's file": lambda folder, out: run(["pose", *map(str, folder.glob("*.html"))]),
    "export": lambda folder, out: run(["export", str(folder), "-o", str(out / "tour.html"), "--model", "sphere"]),
    "pansplat.predict": lambda folder, out: pansplat.predict(folder),
    "the window": lambda folder, out: find_entries(folder, ReadOptions(), PredictOptions()),
}


def test_all_commands_estimate_poses_from_the_same_arguments(linked: Path, tmp_path: Path, estimator) -> None:
    calls: list[tuple[list[Path], dict]] = []

    def record(images, **options) -> PoseEstimate:
        calls.append((list(images), options))
        raise NoPosesError(dict.fromkeys(images, "no door"))

    estimator(record)
    callers = dict(CALLERS)
    if not list(linked.glob("*.html")):
        callers.pop("pose of a tour's file")
    for number, (name, call) in enumerate(callers.items(), start=1):
        for cache in linked.glob(".pansplat/poses-*.entry"):
            cache.unlink()
        with contextlib.suppress(InputError):
            call(linked, tmp_path)
        assert len(calls) == number and calls[-1] == calls[0], name
    images, options = calls[0]
    assert len(images) == 3 and options["links"][images[0]] == {images[1]: pytest.approx(1.5, abs=0.1)}


QUICK = "--no-cache", "--model", "sphere", "--refine", "0"
WITHOUT_CACHES = {
    "predict": lambda folder, out: run(["predict", str(folder), *QUICK, "-o", str(out / "s.ply")]),
    "export": lambda folder, out: run(["export", str(folder), *QUICK, "-o", str(out / "tour.html")]),
    "batch": lambda folder, out: process_item(
        ("tour", folder), Batch(folder, out, prediction=SPHERE), fingerprint_work(SPHERE)
    ),
    "pansplat.predict": lambda folder, out: pansplat.predict(folder, "sphere", cache=False),
    "the window": lambda folder, out: run_viewer(
        [str(folder), "--offscreen", str(out), *QUICK, "--renderer", "cpu", "--size", "32x32", "--seconds", "0.1"]
    ),
}


@pytest.mark.parametrize("linked", ["a web tour of cube faces"], indirect=True)
def test_without_caches_no_file_is_written_to_them_or_read(linked: Path, tmp_path, estimator, monkeypatch) -> None:
    """Poses, overlaps, the floor plan, and the descriptions of cube faces, of a folder without poses."""
    calls, cache, out = [], tmp_path / "cache", linked.parent / "out"
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.chdir(tmp_path)
    out.mkdir()
    fingerprint_work.cache_clear()

    def estimate(images, cache_folder: Path, **options) -> PoseEstimate:
        calls.append(Store(cache_folder).get("features", "of a photograph", lambda: len(calls)))
        return _place_two(images)

    def list_files() -> dict[Path, int]:
        files = [file for folder in (linked, cache) for file in folder.rglob("*")]
        return {file: file.stat().st_mtime_ns for file in files}

    estimator(estimate)
    before = list_files()
    for number, (name, call) in enumerate(WITHOUT_CACHES.items(), start=1):
        call(linked, out)
        assert len(calls) >= number and list_files() == before, name
    pansplat.predict(linked, "sphere")
    kept, calls = list_files(), []
    kinds = {file.name.split("-")[0] for file in kept if file.suffix == ".entry"}
    assert {"poses", "overlaps", "features", "prediction"} <= kinds, "with caches there are files"
    pansplat.predict(linked, "sphere", cache=False)
    assert list_files() == kept and calls == [0], "nothing is read"
    fingerprint_work.cache_clear()


def test_the_written_poses_are_those_that_other_commands_use(linked: Path, estimator) -> None:
    estimator(_place_two)
    before = {view.name: view for pair in pansplat.load_sets(linked) for view in pair.context}
    assert run(["pose", str(linked), "-o", str(linked / "poses.json")]) == 0
    estimator(_refuse)
    after = {view.name: view for pair in pansplat.load_sets(linked) for view in pair.context}
    assert list(after) == list(before) == ["a", "b", "c"]
    for name, view in after.items():
        assert np.array_equal(view.cam2world, before[name].cam2world)
        assert (view.image, view.world, view.links, view.placement.state, view.placement.reason) == (
            *(before[name].image, before[name].world, before[name].links),
            *(before[name].placement.state, before[name].placement.reason),
        )


def test_messages_name_rooms_by_their_titles(linked: Path, estimator, capsys) -> None:
    estimator(lambda images, *, names, **options: replace(_place_two(images), names=names))
    assert run(["pose", str(linked)]) == 0
    error = capsys.readouterr().err
    third = {"links.json": "c.png", "tour.json": "c.png", "data.js": "Room c"}
    name = next(name for file, name in third.items() if (linked / file).exists())
    assert f"{name} has no pose: no door" in error and "cube" not in error


def test_figures_of_reasons_are_for_verbose(folder: Path, estimator, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    relation = RelativePose(np.eye(3), np.eye(3)[2], np.empty((0, 2), int), problem="too little in common: 20 places")
    estimator(lambda images, **options: replace(_place_two(images), relations={tuple(images[:2]): relation}))
    for options in ([], ["--verbose"]):
        assert run(["pose", str(folder), *options]) == 0
        printed = capsys.readouterr().out
        assert "too little in common" in printed and ("20 places" in printed) == bool(options)


def test_poses_of_cube_faces_beside_each_other_are_refused_before_an_estimate(tmp_path, write_tiles, estimator, capsys):
    for name in "ab":
        write_tiles(32, 32, lambda face, row, column, name=name: tmp_path / f"{name}_{face}.png")
    estimator(_refuse)
    assert run(["pose", str(tmp_path), "-o", str(tmp_path / "poses.json")]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "got the cube faces of a, of which it holds no poses" in error and "--photos" in error


@pytest.mark.parametrize("linked", ["a web tour of cube faces"], indirect=True)
def test_poses_of_a_tour_stand_in_its_folder(linked: Path, estimator, refusal) -> None:
    """Not in any other one, also if it has a tour."""
    estimator(_refuse)
    other = linked.parent / "other"
    other.mkdir()
    for _ in range(2):
        error = refusal("pose", linked, "-o", other / "poses.json")
        assert "needed the folder of the web tour, where its poses stand, got another" in error
        (other / "data.js").write_text((linked / "data.js").read_text())
