"""Placing a photograph by hand, without a window: targets, dragging, turning, snapping, saving, undoing, reloading."""

import json
import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import pansplat
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.inputs.pairs import Panorama
from pansplat.poses.dense import Surroundings
from pansplat.poses.depth import DepthMap
from pansplat.poses.placing import WALL_ANGLE, Piece, PlanPose
from pansplat.poses.solvers import rotation_exp
from pansplat.tours.graph import find_tours
from pansplat_viewer.scene.loader import SceneEntry, list_panoramas
from pansplat_viewer.scene.placing import Placing, PlanView

LIVING_ROOM = Path(__file__).resolve().parents[3] / "assets" / "living_room"
HALF = np.array((2.6, 1.2, 2.0))  # of a room, metres; cameras are 1.2 m over its floor
TRUTH = {"a": (-0.9, -0.6, 0.2), "b": (0.9, -0.3, -0.5), "c": (0.1, 0.8, 1.1), "d": (-0.5, 0.9, 2.5)}  # x, z, yaw

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def _write(file: Path) -> None:
    cv2.imwrite(str(file), np.tile(np.linspace(40, 200, 64, dtype=np.uint8)[:, None, None], (1, 128, 3)))


def _pose(name: str) -> np.ndarray:
    x, z, yaw = TRUTH[name]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_exp(np.array((0.0, yaw, 0))), (x, 0, z)
    return pose


def _read(image: Path) -> Piece:
    """The piece of a photograph with exact depth; walls along the room's axes."""
    if image.stem not in TRUTH:
        raise InputError(f"{image}: needed a room, got none; correct it.")
    pose = _pose(image.stem)
    rays = pixel_directions(96, 192, dtype=torch.float64).numpy() @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = ((np.sign(rays) * HALF - pose[:3, 3]) / rays).min(axis=-1)
    points = pose[:3, 3] + rays * distance[..., None]
    waves = np.random.default_rng(0).normal(size=(3, 8)) * 4
    grey = 0.5 + 0.05 * np.sin(points @ waves + np.arange(8)).sum(axis=-1)
    depth = DepthMap(np.log(distance / HALF[1]), np.full((24, 48), 0.03), np.eye(3))
    return Piece(Surroundings(np.dstack((grey,) * 3), depth), -TRUTH[image.stem][2])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Photographs a, b, c, d of a room, of which a and b have a pose; suggestions place c nearly right, and wrong."""
    for name in TRUTH:
        _write(tmp_path / f"{name}.png")
    right = np.linalg.inv(_pose("a")) @ _pose("c")
    place = [right[0, 3] / 1.2 + 0.02, right[2, 3] / 1.2, TRUTH["c"][2] - TRUTH["a"][2] + 0.02]
    suggestions = [{"between": ["a.png", "c.png"], "places": [[2.0, -1.0, 2.0, -0.5], [*place, -2.0]]}]
    content = {
        "convention": "cam2world opencv",
        "worlds": [{"near": 0.3, "far": 8.0, "unit": 1.2}],
        "poses": {f"{name}.png": {"cam2world": _pose(name).tolist(), "remark": "kept"} for name in "ab"},
        "estimate": {"unplaced": {"c.png": "no door"}, "suggestions": suggestions},
    }
    (tmp_path / "poses.json").write_text(json.dumps(content))
    return tmp_path


def _load(folder: Path) -> list[Panorama]:
    pairs = pansplat.load_pairs(folder)
    return list_panoramas([SceneEntry(pair.name, pair=pair) for pair in pairs], folder)


@pytest.fixture
def placing(folder: Path):
    placing = Placing(folder, _load(folder), read=_read)
    yield placing
    placing.close()


def _wait(placing: Placing, condition: Callable[[], bool] | None = None) -> None:
    """Wait until a condition holds, or all pieces are read."""
    deadline = time.monotonic() + 300
    while not (condition() if condition else not (placing.is_reading or placing.missing)):
        assert time.monotonic() < deadline
        placing.update()
        time.sleep(0.005)
    placing.update()


@pytest.fixture
def started(placing: Placing) -> Placing:
    """Photograph c is placed beside a and b."""
    placing.start(2)
    _wait(placing)
    return placing


def _true_place(placing: Placing, name: str = "c") -> PlanPose:
    return placing.floor.find_place(_pose(name), np.eye(3))


def test_a_photograph_is_placed_beside_its_own_group_or_another_one(placing: Placing):
    assert placing.list_targets(2) == [(0, 1), (3,)]
    assert placing.list_targets(0) == [(1,), (2,), (3,)]


def test_a_link_of_the_tour_is_a_suggestion_after_those_of_the_estimate(folder: Path):
    (folder / "links.json").write_text(json.dumps({"b": [{"to": "d", "yaw": 0.4, "pitch": 0.5}]}))
    placing = Placing(folder, _load(folder), read=_read)
    placing.start(3)
    _wait(placing)
    (ghost,) = placing.ghosts
    assert ghost.log_odds == -math.inf and ghost.other == 1 and placing.shown.suggestion == 0
    assert ghost.place.distance(placing.places[1]) == pytest.approx(1.2 / math.tan(0.5))
    placing.close()


def test_a_place_that_fits_poorly_is_saved_by_a_second_call_only(started: Placing, folder: Path):
    before = (folder / "poses.json").read_bytes()
    started.move(9.0, 9.0, free=True)
    started.update()
    assert started.fit is None or started.fit.quality < 0.25
    assert not started.save() and started.is_doubted and (folder / "poses.json").read_bytes() == before
    started.move(0.5, 0.0, free=True)
    assert not started.is_doubted and not started.save()
    assert started.save() and (folder / "poses.json").read_bytes() != before


def test_a_drag_near_a_suggestion_snaps_and_leaves_it_again_unless_alt_is_held(started: Placing):
    target = started.ghosts[1].place
    started.turn_to(target.yaw, free=True)
    place = started.shown.place
    started.move(target.right - place.right + 0.2, target.forward - place.forward)
    assert started.shown.suggestion == 1 and started.shown.place == target
    started.move(0.4, 0.0)
    assert started.shown.suggestion is None
    assert started.shown.place.right == pytest.approx(target.right + 0.6)
    started.move(-0.5, 0.0, free=True)
    assert started.shown.suggestion is None and started.shown.place.right == pytest.approx(target.right + 0.1)


def test_walls_of_the_piece_become_parallel_to_those_of_the_plan_unless_alt_is_held(started: Placing):
    parallel = _true_place(started).yaw + math.pi / 2
    started.move(3.0, 0.0, free=True)
    started.turn_to(parallel + 0.7 * WALL_ANGLE)
    assert started.shown.is_aligned
    assert math.remainder(started.shown.place.yaw - parallel, math.tau) == pytest.approx(0, abs=1e-6)
    started.turn_to(parallel + 0.7 * WALL_ANGLE, free=True)
    assert math.remainder(started.shown.place.yaw - parallel, math.tau) == pytest.approx(0.7 * WALL_ANGLE)


def test_the_fit_follows_the_piece(started: Placing):
    started.update()
    wrong = started.fit
    started.go_to(1)
    started.update()
    assert started.fit.quality > 0.8 and wrong is not None and wrong.quality < 0.3


def test_an_adjustment_finds_the_place_of_the_best_fit_nearby(started: Placing):
    truth = _true_place(started)
    started.turn_to(truth.yaw + 0.1, free=True)
    place = started.shown.place
    started.move(truth.right + 0.2 - place.right, truth.forward - 0.15 - place.forward, free=True)
    started.update()
    before = started.fit.score
    started.adjust()
    while started.is_adjusting:
        started.update()
    assert started.fit.score > before + 0.2
    assert started.shown.place.distance(truth) < 0.04 and started.shown.place.turn_between(truth) < 0.02
    started.adjust()
    started.move(0.5, 0.0, free=True)  # a drag ends it
    assert not started.is_adjusting


def test_a_photograph_placed_at_its_true_pose_is_in_the_tour_after_saving_and_reloading(started: Placing, folder: Path):
    before = json.loads((folder / "poses.json").read_text())
    truth = _true_place(started)
    started.turn_to(truth.yaw, free=True)
    place = started.shown.place
    started.move(truth.right - place.right, truth.forward - place.forward, free=True)
    started.drop()
    assert started.save() and started.is_changed and started.error is None
    content = json.loads((folder / "poses.json").read_text())
    assert content["poses"].pop("c.png")["placed"] == "by hand" and content == before
    pairs = pansplat.load_pairs(folder)
    (tour,) = find_tours(pairs)
    views = {view.name: view for view in tour.originals}
    assert views["c"].placement.state == "by hand" and views["c"].world == views["a"].world
    assert np.allclose(views["c"].cam2world.numpy(), _pose("c"), atol=1e-6)
    node = [view.name for view in tour.panoramas].index("c")
    assert tour.neighbours(node) and (node, node) not in tour.overlaps
    started.reopen(_load(folder))
    assert not started.is_changed and started.panoramas[2].placement.state == "by hand"
    started.undo()
    assert json.loads((folder / "poses.json").read_text()) == before
    assert started.panoramas[2].placement.state == "not placed"


def test_a_placed_photograph_is_corrected_where_it_is_and_keeps_its_height_and_tilt(folder: Path):
    content = json.loads((folder / "poses.json").read_text())
    pose = _pose("b")
    pose[1, 3], pose[:3, :3] = 0.2, pose[:3, :3] @ rotation_exp(np.array((0.04, 0, 0)))
    content["poses"]["b.png"]["cam2world"] = pose.tolist()
    (folder / "poses.json").write_text(json.dumps(content))
    placing = Placing(folder, _load(folder), read=_read)
    placing.start(1)
    _wait(placing)
    assert placing.targets == (0,)
    assert np.allclose(placing.find_poses()[1], pose, atol=1e-9)
    placing.move(0.5, 0.0, free=True)
    moved = placing.find_poses()[1]
    assert np.allclose(moved[:3, :3], pose[:3, :3]) and moved[1, 3] == pytest.approx(0.2)
    assert np.linalg.norm(moved[:3, 3] - pose[:3, 3]) == pytest.approx(0.5)
    assert placing.save() or placing.save()
    assert json.loads((folder / "poses.json").read_text())["poses"]["b.png"]["remark"] == "kept"
    placing.close()


def test_photographs_without_poses_are_placed_beside_each_other_and_move_as_a_group(placing: Placing, folder: Path):
    placing.start(3, (2,))
    _wait(placing)
    placing.move(0.5, 0.5, free=True)
    assert placing.save() or placing.save()
    views = {view.name: view for view in _load(folder)}
    assert views["c"].world == views["d"].world != views["a"].world
    assert views["c"].placement.state == views["d"].placement.state == "by hand"
    assert json.loads((folder / "poses.json").read_text())["worlds"][1]["unit"] == pytest.approx(1.5)
    before = np.linalg.inv(placing._get_pose(3)) @ placing._get_pose(2)
    placing.start(3, with_group=True)
    _wait(placing)
    assert placing.targets == (0, 1) and placing.moved == (3, 2)
    placing.move(0.3, 0.0, free=True)
    placing.turn(2, free=True)
    assert placing.outline(2) is not None
    assert placing.save() or placing.save()
    views = {view.name: view for view in _load(folder)}
    assert views["c"].world == views["d"].world == views["a"].world
    after = np.linalg.inv(views["d"].cam2world.numpy()) @ views["c"].cam2world.numpy()
    assert np.allclose(after, before, atol=1e-6)


def test_a_folder_that_cannot_be_written_gives_a_message_and_changes_nothing(started: Placing, folder, monkeypatch):
    before = (folder / "poses.json").read_bytes()

    def refuse(*args) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("os.replace", refuse)
    assert not started.save() and not started.save()
    assert "cannot write" in started.error and "Read-only file system" in started.error
    assert (folder / "poses.json").read_bytes() == before
    assert not started.is_changed and started.panoramas[2].placement.state == "not placed"


@pytest.mark.parametrize(("unit", "origin"), [(1e3, 0.0), (1.0, 5e6)])
def test_photographs_are_placed_in_the_world_of_their_file(folder: Path, unit: float, origin: float):
    content = json.loads((folder / "poses.json").read_text())
    content["worlds"][0] |= {"near": 0.45 * unit, "far": 8.0 * unit}
    for entry in content["poses"].values():
        for row in entry["cam2world"][:3]:
            row[3] = unit * row[3] + origin
    (folder / "poses.json").write_text(json.dumps(content))
    photographs = _load(folder)
    assert Placing(folder, photographs).problem is None
    for view, (name, entry) in zip(photographs, content["poses"].items(), strict=False):
        assert view.image.name == name and np.allclose(view.cam2world, entry["cam2world"], rtol=0, atol=1e-8)


def test_a_photograph_that_cannot_be_read_is_not_placed(folder: Path):
    _write(folder / "other.png")
    placing = Placing(folder, _load(folder), read=_read)
    placing.start(4)
    _wait(placing, lambda: placing.node is None)
    assert "needed a room" in placing.error
    placing.close()


def test_poses_of_other_formats_are_listed_as_not_changeable(folder: Path):
    views = [Panorama(name, folder / f"{name}.png", torch.eye(4, dtype=torch.float64)) for name in TRUTH]
    placing = Placing(folder, views, read=_read)
    assert not placing.is_listed and "got another format" in placing.problem
    placing.start(0)
    assert placing.node is None and placing.error == placing.problem


def test_a_view_of_a_plan_has_all_points_and_one_scale():
    points = np.array(((-3.0, 1.0), (5.0, 4.0)))
    view = PlanView.of_points(points, (400, 300))
    assert view.contains(points) and not view.contains(points + 50)
    middle, moved = np.array(view.middle), view.pixels_per_metre * np.array((2, -3))
    assert view.to_pixels(middle) == pytest.approx((200, 150))
    assert view.to_pixels(middle + np.array((2, 3))) - (200, 150) == pytest.approx(moved)  # forward is up


@pytest.mark.slow
def test_the_estimated_depth_of_real_photographs_shows_the_right_place(tmp_path: Path):
    """The middle photograph of the sample loses its pose, and is placed where it was."""
    folder = tmp_path / "living_room"
    shutil.copytree(LIVING_ROOM, folder, ignore=shutil.ignore_patterns(".*", "pairs.json"))
    content = json.loads((folder / "poses.json").read_text())
    entry = content["poses"].pop("middle.jpg")
    truth = np.array(entry["cam2world"] if isinstance(entry, dict) else entry)
    (folder / "poses.json").write_text(json.dumps(content))
    placing = Placing(folder, _load(folder))
    node = [view.name for view in placing.panoramas].index("middle")
    placing.start(node)
    _wait(placing)
    piece = placing.pieces[placing.panoramas[node].image]
    place = placing.floor.find_place(truth, piece.upright)
    found = {}
    for name, (right, turn) in {"right": (0, 0), "beside": (0.4, 0), "turned": (0, 0.3)}.items():
        placing.turn_to(place.yaw + turn, free=True)
        shown = placing.shown.place
        placing.move(place.right + right - shown.right, place.forward - shown.forward, free=True)
        placing.update()
        found[name] = placing.fit.likeness
    assert found["right"] > 0.6 > found["beside"] and found["right"] > found["turned"] + 0.2
    placing.turn_to(place.yaw, free=True)
    shown = placing.shown.place
    placing.move(place.right - shown.right, place.forward - shown.forward, free=True)
    assert placing.save() or placing.save()
    placing.close()
    views = {view.name: view for view in _load(folder)}
    assert views["middle"].world == views["left"].world
    assert np.allclose(views["middle"].cam2world[:3, 3], truth[:3, 3], atol=0.05)
    assert np.allclose(views["middle"].cam2world[:3, :3], truth[:3, :3], atol=0.02)
