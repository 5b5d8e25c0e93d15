"""Placing a panorama by hand, without a window: where it starts, dragging, turning, walls, saving, undoing."""

import json
import math
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import pansplat
from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.level import wrap_angle
from pansplat.inputs.panorama_sets import Panorama
from pansplat.inputs.placements import Placement
from pansplat.poses.dense import Surroundings
from pansplat.poses.depth import DepthMap
from pansplat.poses.placing import Piece, PlanPose
from pansplat.poses.solvers import rotation_exp
from pansplat.tours.graph import find_tours
from pansplat_viewer.core.loader import SceneEntry, list_panoramas_of_folder
from pansplat_viewer.core.placing_by_hand import WALL_ANGLE, PlacingByHand, PlanView

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
        raise InputError(f"{image}: no room")
    pose = _pose(image.stem)
    rays = pixel_directions(96, 192, dtype=torch.float64).numpy() @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = ((np.sign(rays) * HALF - pose[:3, 3]) / rays).min(axis=-1)
    depth = DepthMap(np.log(distance / HALF[1]), np.full((24, 48), 0.03), np.eye(3))
    return Piece(Surroundings(np.zeros((96, 192, 3)), depth), -TRUTH[image.stem][2])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Photographs a, b, c, d of a room, of which a and b have a pose; c is about 0.1 m beside where it is."""
    for name in TRUTH:
        _write(tmp_path / f"{name}.png")
    truth = np.linalg.inv(_pose("a")) @ _pose("c")
    place = [(truth[0, 3] + 0.1) / 1.2, truth[2, 3] / 1.2, TRUTH["c"][2] - TRUTH["a"][2]]
    content = {
        "convention": "cam2world opencv",
        "worlds": [{"near": 0.3, "far": 8.0, "unit": 1.2}],
        "poses": {f"{name}.png": {"cam2world": _pose(name).tolist(), "remark": "kept"} for name in "ab"},
        "estimate": {"approximate": [{"between": ["a.png", "c.png"], "place": place}]},
    }
    (tmp_path / "poses.json").write_text(json.dumps(content))
    return tmp_path


def _list(folder: Path) -> list[SceneEntry]:
    return [SceneEntry(pair.name, pair=pair) for pair in pansplat.load_sets(folder)]


def _load(folder: Path) -> list[Panorama]:
    return list_panoramas_of_folder(_list(folder), folder)


@pytest.fixture
def placing(folder: Path):
    placing = PlacingByHand(folder, _load(folder), read=_read)
    yield placing
    placing.close()


def _place(placing: PlacingByHand, node: int, targets: tuple[int, ...] | None = None) -> None:
    """Start to place a photograph, and wait until all pieces are read."""
    placing.start(node, targets)
    deadline = time.monotonic() + 300
    while placing.progress is not None or (placing.node is not None and placing.place is None):
        assert time.monotonic() < deadline
        placing.update()
        time.sleep(0.005)


@pytest.fixture
def started(placing: PlacingByHand) -> PlacingByHand:
    """Photograph c is placed beside a and b."""
    _place(placing, 2)
    return placing


def _move_to(placing: PlacingByHand, truth: PlanPose) -> None:
    placing.turn(truth.yaw - placing.place.yaw)
    placing.move(truth.right - placing.place.right, truth.forward - placing.place.forward)


def _true_place(placing: PlacingByHand, name: str = "c") -> PlanPose:
    return placing.floor.find_place(_pose(name), np.eye(3))


def test_a_panorama_is_placed_beside_its_own_group_or_else_that_of_its_approximate_place(folder: Path, placing):
    assert placing.list_targets(0) == [(1,), (2,), (3,)]
    assert placing.list_targets(3) == [(0, 1), (2,)]
    content = json.loads((folder / "poses.json").read_text())
    content["estimate"]["approximate"][0]["between"] = ["d.png", "c.png"]
    (folder / "poses.json").write_text(json.dumps(content))
    assert PlacingByHand(folder, _load(folder)).list_targets(2) == [(3,), (0, 1)]


@pytest.mark.parametrize("unit", [1.2, None])
def test_a_panorama_starts_at_its_approximate_place(folder: Path, unit: float | None):
    content = json.loads((folder / "poses.json").read_text())
    content["worlds"][0]["unit"] = unit
    (folder / "poses.json").write_text(json.dumps(content))
    placing = PlacingByHand(folder, _load(folder), read=_read)
    _place(placing, 2)
    (stated,) = content["estimate"]["approximate"]
    expected = _true_place(placing, "a").add(PlanPose(*stated["place"]), unit or 1.5)
    assert placing.place.distance(expected) < 1e-6 and placing.place.turn_between(expected) < 1e-6
    placing.close()


def test_a_panorama_to_which_only_a_link_leads_starts_behind_the_door(folder: Path):
    (folder / "links.json").write_text(json.dumps({"b": [{"to": "d", "yaw": -2.0}]}))
    placing = PlacingByHand(folder, _load(folder), read=_read)
    _place(placing, 3)
    (door,), camera = placing.find_doors(), np.array(placing.find_place(1)[:2])
    ahead = (door - camera) / np.linalg.norm(door - camera)
    assert ((placing.outline(3) - door) @ ahead).min() == pytest.approx(0.3)
    side = np.array((ahead[1], -ahead[0]))
    assert (placing.place[:2] - door) @ side == pytest.approx(0, abs=1e-9) and placing.is_aligned
    placing.close()


def test_a_panorama_of_which_nothing_is_known_starts_beside_the_others_with_parallel_walls(placing: PlacingByHand):
    _place(placing, 3)
    assert placing.is_aligned
    assert placing.outline(3)[:, 0].min() > placing.outline(0)[:, 0].max() + 0.25


def test_walls_snap_to_those_of_the_plan_when_they_are_nearly_parallel(started: PlacingByHand):
    parallel = _true_place(started).yaw + math.pi / 2
    for factor, is_parallel in ((0.9, True), (-0.9, True), (1.1, False)):
        before = started.place
        started.turn_to(parallel + factor * WALL_ANGLE)
        assert started.is_aligned == is_parallel and started.place[:2] == before[:2]
        assert math.remainder(started.place.yaw - parallel, math.tau) == pytest.approx(
            0 if is_parallel else factor * WALL_ANGLE, abs=1e-6
        )
    started.turn(0.01)
    assert not started.is_aligned, "the wheel turns freely"


def test_links_between_the_panorama_and_the_others_meet_the_outlines_at_their_doors(folder: Path):
    links = {"a": [{"to": "c", "yaw": 0.7}], "c": [{"to": "a", "yaw": -1.9}, {"to": "d", "yaw": 0}]}
    (folder / "links.json").write_text(json.dumps(links))
    placing = PlacingByHand(folder, _load(folder), read=_read)
    _place(placing, 2)
    for door, node, yaw in zip(placing.find_doors(), (0, 2), (0.7, -1.9), strict=True):
        place = placing.find_place(node)
        assert np.abs(placing.outline(node) - door).sum(axis=1).min() < 1e-9
        assert math.atan2(*(door - place[:2])) == pytest.approx(wrap_angle(place.yaw + yaw), abs=0.05)
    placing.close()


def test_a_panorama_placed_at_its_true_pose_is_in_the_tour_after_saving_and_undo_restores(started, folder):
    before = (folder / "poses.json").read_bytes()
    _move_to(started, _true_place(started))
    assert started.save() and started.node is None and started.error is None
    content = json.loads((folder / "poses.json").read_text())
    assert content["poses"].pop("c.png")["placed"] == "by hand" and content == json.loads(before)
    (tour,) = find_tours(pansplat.load_sets(folder))
    views = {view.name: view for view in tour.originals}
    assert views["c"].placement.state == "by hand" and views["c"].world == views["a"].world
    assert np.allclose(views["c"].cam2world.numpy(), _pose("c"), atol=1e-6)
    node = [view.name for view in tour.panoramas].index("c")
    assert tour.neighbours(node) and (node, node) not in tour.overlaps
    started.start(3)
    assert started.node is None and "changed poses" in started.error, "they are not loaded yet"
    assert started.reopen(_list(folder)) and started.panoramas[2].placement.state == "by hand"
    assert started.undo() and (folder / "poses.json").read_bytes() == before
    assert started.reopen(_list(folder)) and started.panoramas[2].placement.state == "not placed"
    assert not started.can_undo


def test_a_placed_photograph_is_corrected_where_it_is_and_keeps_its_height_and_tilt(folder: Path):
    content = json.loads((folder / "poses.json").read_text())
    pose = _pose("b")
    pose[1, 3], pose[:3, :3] = 0.2, pose[:3, :3] @ rotation_exp(np.array((0.04, 0, 0)))
    content["poses"]["b.png"]["cam2world"] = pose.tolist()
    (folder / "poses.json").write_text(json.dumps(content))
    placing = PlacingByHand(folder, _load(folder), read=_read)
    _place(placing, 1)
    assert placing.targets == (0,)
    assert np.allclose(placing.find_poses()[1], pose, atol=1e-9)
    placing.move(0.5, 0.0)
    moved = placing.find_poses()[1]
    assert np.allclose(moved[:3, :3], pose[:3, :3]) and moved[1, 3] == pytest.approx(0.2)
    assert np.linalg.norm(moved[:3, 3] - pose[:3, 3]) == pytest.approx(0.5)
    assert placing.save()
    assert json.loads((folder / "poses.json").read_text())["poses"]["b.png"]["remark"] == "kept"
    placing.close()


def test_panoramas_without_poses_are_placed_beside_each_other_and_move_as_a_group(placing: PlacingByHand, folder: Path):
    _place(placing, 3, (2,))
    placing.move(0.5, 0.5)
    assert placing.save() and placing.reopen(_list(folder))
    views = {view.name: view for view in placing.panoramas}
    assert views["c"].world == views["d"].world != views["a"].world
    assert views["c"].placement.state == views["d"].placement.state == "by hand"
    assert json.loads((folder / "poses.json").read_text())["worlds"][1]["unit"] == pytest.approx(1.5)
    before = np.linalg.inv(views["d"].cam2world.numpy()) @ views["c"].cam2world.numpy()
    _place(placing, 3, (0, 1))
    assert placing.moved == (3, 2) and placing.outline(2) is not None
    placing.move(0.3, 0.0)
    placing.turn(0.2)
    assert placing.save()
    views = {view.name: view for view in _load(folder)}
    assert views["c"].world == views["d"].world == views["a"].world
    after = np.linalg.inv(views["d"].cam2world.numpy()) @ views["c"].cam2world.numpy()
    assert np.allclose(after, before, atol=1e-6)


def test_photographs_are_placed_in_the_world_of_their_file(folder: Path):
    unit, origin = 1e3, 5e6
    content = json.loads((folder / "poses.json").read_text())
    content["worlds"][0] |= {"near": 0.45 * unit, "far": 8.0 * unit}
    for entry in content["poses"].values():
        for row in entry["cam2world"][:3]:
            row[3] = unit * row[3] + origin
    (folder / "poses.json").write_text(json.dumps(content))
    photographs = _load(folder)
    assert PlacingByHand(folder, photographs).problem is None
    for view, (name, entry) in zip(photographs, content["poses"].items(), strict=False):
        assert view.image.name == name and np.allclose(view.cam2world, entry["cam2world"], rtol=0, atol=1e-8)


def test_a_photograph_that_cannot_be_read_is_not_placed(folder: Path):
    _write(folder / "other.png")
    placing = PlacingByHand(folder, _load(folder), read=_read)
    _place(placing, 4)
    assert placing.node is None and "other.png: no room" in placing.error
    _place(placing, 3)
    assert placing.node == 3 and placing.outline(4) is None, "others can still be placed"
    placing.close()


def test_poses_of_other_formats_are_listed_as_not_changeable(folder: Path):
    views = [Panorama(name, folder / f"{name}.png", torch.eye(4, dtype=torch.float64)) for name in TRUTH]
    placing = PlacingByHand(folder, views, read=_read)
    assert not placing.is_listed and "got another format" in placing.problem
    placing.start(0)
    assert placing.node is None and placing.error == placing.problem


def test_panoramas_can_be_placed_when_their_poses_are_estimated(folder: Path):
    """A window has them before, without poses."""
    entries = _list(folder)
    before = PlacingByHand(folder, [replace(view, placement=Placement("not placed")) for view in _load(folder)])
    placing = PlacingByHand.open(before, entries[0], entries)
    assert before.problem and placing.problem is None and placing.is_listed
    assert PlacingByHand.open(placing, entries[-1], entries) is placing, "so that its changes can be undone"
    assert PlacingByHand.open(placing, None, []) is None


def test_a_view_of_a_plan_has_all_points_and_one_scale():
    points = np.array(((-3.0, 1.0), (5.0, 4.0)))
    view = PlanView.of_points(points, (400, 300))
    assert view.contains(points) and not view.contains(points + 50)
    middle, moved = np.array(view.middle), view.pixels_per_metre * np.array((2, -3))
    assert view.to_pixels(middle) == pytest.approx((200, 150))
    assert view.to_pixels(middle + np.array((2, 3))) - (200, 150) == pytest.approx(moved)  # forward is up


@pytest.mark.slow
def test_real_photographs_are_placed_upright_by_their_estimated_axes(tmp_path: Path):
    """The middle photograph of the sample loses its pose, and is placed where it was."""
    folder = tmp_path / "living_room"
    shutil.copytree(LIVING_ROOM, folder, ignore=shutil.ignore_patterns(".*", "pairs.json"))
    content = json.loads((folder / "poses.json").read_text())
    entry = content["poses"].pop("middle.jpg")
    truth = np.array(entry["cam2world"] if isinstance(entry, dict) else entry)
    (folder / "poses.json").write_text(json.dumps(content))
    placing = PlacingByHand(folder, _load(folder))
    node = [view.name for view in placing.panoramas].index("middle")
    _place(placing, node)
    _move_to(placing, placing.floor.find_place(truth, placing.pieces[placing.panoramas[node].image].upright))
    placing.turn_to(placing.place.yaw)
    assert placing.is_aligned and placing.save()
    placing.close()
    views = {view.name: view for view in _load(folder)}
    assert views["middle"].world == views["left"].world
    assert np.allclose(views["middle"].cam2world[:3, 3], truth[:3, 3], atol=0.05)
    assert np.allclose(views["middle"].cam2world[:3, :3], truth[:3, :3], atol=0.02)
