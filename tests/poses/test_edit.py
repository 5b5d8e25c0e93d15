"""Placing by hand and new estimates change poses.json only where they must, survive loading, and are undone."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from refusals import expect_error

import pansplat
from pansplat.inputs.panorama_sets import Panorama
from pansplat.inputs.placements import ApproximatePlace
from pansplat.poses.approximate import LinkedPlace
from pansplat.poses.edit import PoseEditor
from pansplat.poses.estimate import PoseEstimate, PoseGroup
from pansplat.poses.files import write_poses
from pansplat.poses.placing import PlanPose
from pansplat.poses.solvers import rotation_exp

NAMES = "abcdef"


def _estimate(images, **options) -> PoseEstimate:
    """Poses of a to e, 1 m apart along x; f is not placed."""
    images = list(images)
    poses = {}
    for step, image in enumerate(images[:5]):
        poses[image] = np.eye(4)
        poses[image][0, 3] = step
    return PoseEstimate(
        tuple(images),
        (PoseGroup(poses, 0.4, 8.0, 0.0, "a test", 1.6),),
        {images[5]: "no door"} if len(images) > 5 else {},
        {},
        approximate={images[5]: LinkedPlace(images[0], PlanPose(1.0, 2.0, 0.5), (images[1],))}
        if len(images) > 5
        else {},
    )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    for number, name in enumerate(NAMES):
        noise = np.random.default_rng(number).integers(0, 255, (8, 16, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{name}.png"), cv2.resize(noise, (128, 64), interpolation=cv2.INTER_CUBIC))
    monkeypatch.setattr("pansplat.poses.files.estimate_poses", _estimate)
    return tmp_path


def _load(folder: Path) -> dict[str, Panorama]:
    pairs = pansplat.load_sets(folder)
    return {view.name: view for pair in pairs for view in pair.context}


def _states(folder: Path) -> dict[str, str]:
    return {name: view.placement.state for name, view in sorted(_load(folder).items())}


def _edit(folder: Path) -> PoseEditor:
    return PoseEditor(folder, list(_load(folder).values()))


def _content(folder: Path) -> dict:
    return json.loads((folder / "poses.json").read_text())


pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

ALL = {"a": "placed", "b": "placed", "c": "placed", "d": "placed", "e": "placed", "f": "not placed"}


def test_states_and_reasons_are_those_of_the_estimate_also_from_its_cache_and_from_a_file(folder: Path, monkeypatch):
    for _ in range(2):
        views = _load(folder)
        assert _states(folder) == ALL
        assert views["f"].placement.reason == "no door"
        monkeypatch.setattr("pansplat.poses.files.estimate_poses", None)
    write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    assert _states(folder) == ALL
    assert _load(folder)["f"].placement.reason == "no door"


def test_a_pose_placed_by_hand_is_in_the_world_of_the_others_and_undone_in_steps(folder: Path):
    editor, pose = _edit(folder), np.eye(4)
    pose[:3, 3] = 0.5, 0, 2
    world = _load(folder)["a"].world
    editor.place({folder / "f.png": pose}, world)
    first = (folder / "poses.json").read_bytes()
    view = _load(folder)["f"]
    assert view.placement.state == "by hand" and view.world == world
    assert np.allclose(view.cam2world.numpy(), pose)
    editor.place({folder / "e.png": pose}, world)
    editor.undo()
    assert (folder / "poses.json").read_bytes() == first
    editor.undo()
    assert not (folder / "poses.json").exists() and not editor.can_undo
    expect_error("needed a change to undo", editor.undo)


def test_saving_keeps_other_entries_fields_and_the_convention(folder: Path):
    opengl = np.diag((1.0, -1, -1, 1))
    inverse = {}
    for step, name in enumerate("ab"):
        pose = np.eye(4)
        pose[0, 3] = step
        inverse[f"{name}.png"] = np.linalg.inv(pose @ opengl).tolist()
    cv2.imwrite(str(folder / "b_depth.png"), np.zeros((8, 16), np.uint16))
    stated = {
        "convention": "world2cam opengl",
        "near": 0.3,
        "far": 7,
        "author": {"name": "me"},
        "poses": {"a.png": inverse["a.png"], "b.png": {"pose": inverse["b.png"], "depth": "b_depth.png", "note": 3}},
    }
    (folder / "poses.json").write_text(json.dumps(stated))
    pose = np.eye(4)
    pose[:3, 3] = 2, 0, 1
    _edit(folder).place({folder / "c.png": pose, folder / "b.png": pose}, 0)
    content = _content(folder)
    assert content == content | {key: stated[key] for key in ("convention", "near", "far", "author")}
    assert content["poses"]["a.png"] == stated["poses"]["a.png"]
    b = content["poses"]["b.png"]
    assert b == b | {"depth": "b_depth.png", "note": 3, "placed": "by hand"}
    views = _load(folder)
    assert all(np.allclose(views[name].cam2world.numpy(), pose) for name in "bc")
    assert np.allclose(views["a"].cam2world.numpy(), np.eye(4))


def test_poses_that_were_read_in_another_convention_are_not_changed(folder: Path):
    write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    views = [view for pair in pansplat.load_sets(folder, convention="cam2world opengl") for view in pair.context]
    expect_error("needed poses in the convention of the file", PoseEditor, folder, views)


def test_a_change_of_another_program_is_kept(folder: Path):
    editor = _edit(folder)
    editor.place({folder / "f.png": np.eye(4)}, 0)
    content = _content(folder) | {"remark": "mine"}
    (folder / "poses.json").write_text(json.dumps(content))
    expect_error("needed the file as it was written", editor.undo)
    editor.place({folder / "e.png": np.eye(4)}, 0)
    assert _content(folder)["remark"] == "mine"


def test_photographs_placed_beside_each_other_only_get_a_world_of_their_own(folder: Path):
    editor, pose = _edit(folder), np.eye(4)
    pose[0, 3] = 1.5
    editor.place({folder / "e.png": np.eye(4), folder / "f.png": pose}, None, 1.4)
    views = _load(folder)
    assert views["e"].world == views["f"].world != views["a"].world
    assert _states(folder) == ALL | {"e": "by hand", "f": "by hand"}
    assert editor.read_unit(views["f"].world) == 1.4 and editor.read_unit(0) == 1.6


def test_an_approximate_place_is_kept_from_the_cache_to_the_file_and_a_place_by_hand_replaces_it(folder: Path):
    file, place = folder / "a.png", (1.6, 3.2, 0.5)  # one camera height is 1.6 m
    assert _load(folder)["f"].placement.about == ApproximatePlace(file, *place, ("b",))
    write_poses(_estimate([folder / f"{name}.png" for name in NAMES]), folder / "poses.json")
    content = _content(folder)
    stated = {"between": ["a.png", "f.png"], "place": [1.0, 2.0, 0.5], "by": ["b.png"], "sure": False}
    assert content["estimate"]["approximate"] == [stated] and "f.png" not in content["poses"]
    views = _load(folder)
    assert views["f"].placement.about == ApproximatePlace(file, *place, ("b.png",))
    assert views["f"].placement.state == "not placed" and torch.equal(views["f"].cam2world, torch.eye(4).double())
    faulty = [3, {"between": ["a.png"]}, stated | {"place": ["x", 0, 0]}, stated | {"between": ["f.png", "f.png"]}]
    content["estimate"]["approximate"] = [*faulty, {"between": ["gone.png", "f.png"], "place": [0, 0, 0]}]
    (folder / "poses.json").write_text(json.dumps(content))
    assert _load(folder)["f"].placement.about is None
    write_poses(_estimate([folder / f"{name}.png" for name in NAMES]), folder / "poses.json")
    assert _load(folder)["f"].placement.about is not None
    _edit(folder).place({folder / "f.png": np.eye(4)}, 0)
    placement = _load(folder)["f"].placement
    assert placement.state == "by hand" and placement.about is None


def test_a_new_estimate_keeps_the_poses_by_hand_and_adds_others_beside_them(folder: Path):
    """The new estimate has its origin elsewhere."""
    editor, pose = _edit(folder), np.eye(4)
    pose[:3, 3] = 0, 0, 3
    editor.place({folder / "b.png": pose}, 0)
    content = _content(folder)
    del content["poses"]["c.png"]
    content["worlds"][0]["unit"] = 3.2  # metres, twice those of the new estimate
    (folder / "poses.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match=r"a\.png, b\.png, d\.png, e\.png: .*`--overwrite`"):
        write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    views = _load(folder)
    assert np.allclose(views["b"].cam2world.numpy(), pose) and views["b"].placement.state == "by hand"
    assert np.allclose(views["c"].cam2world[:3, 3], (2, 0, 3))  # beside b, the nearest one


def test_all_groups_of_an_estimate_are_written(folder: Path):
    images = sorted(folder.glob("*.png"))
    pose = np.eye(4)
    pose[:3, :3] = rotation_exp(np.array((0.1, 0.7, -0.2)))
    poses = [{image: pose for image in part} for part in (images[:2], images[2:4])]
    groups = tuple(PoseGroup(own, 0.3 + n, 8.0 + n, 0.0, "a test") for n, own in enumerate(poses))
    write_poses(PoseEstimate(tuple(images), groups, {}, {}), folder / "poses.json")
    assert _states(folder) == dict.fromkeys("abcd", "placed") | dict.fromkeys("ef", "not placed")
    pairs = pansplat.load_sets(folder)
    assert np.allclose(pairs[0].context[0].cam2world, pose)
    assert [[view.world for view in pair.context] for pair in pairs[:2]] == [[0, 0], [1, 1]]
    assert [(pair.near, pair.far) for pair in pairs[:2]] == [(0.3, 8), (1.3, 9)]


def _scaled(factor: float, images: list[Path], start: int = 0) -> PoseEstimate:
    """As `_estimate` with another scale; the first panoramas are not placed."""
    found = _estimate(images)
    poses = {image: pose.copy() for image, pose in list(found.poses.items())[start:]}
    for pose in poses.values():
        pose[:3, 3] *= factor
    group = PoseGroup(poses, round(0.4 * factor, 3), 8.0 * factor, 0.0, "a test", 1.6 * factor)
    unplaced = found.unplaced | dict.fromkeys(images[:start], "no wall")
    return PoseEstimate(found.images, (group,), unplaced, found.relations)


def _write_edited(folder: Path, change) -> None:
    """An estimated poses.json after a change by its user, who writes it with other spaces."""
    write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    content = _content(folder)
    change(content)
    (folder / "poses.json").write_text(json.dumps(content, indent=4))


def test_what_a_user_adds_to_estimated_poses_stays_and_the_poses_are_estimated_anew(folder: Path):
    cv2.imwrite(str(folder / "own.jpg"), np.full((8, 16, 3), 255, np.uint8))

    def change(content: dict) -> None:
        content |= {"near": 0.2, "far": 5, "author": {"name": "me"}}
        content["worlds"][0]["note"] = 7
        content["poses"]["b.png"] = {
            "cam2world": content["poses"]["b.png"], "room": "Bath", "mask": "own.jpg", "note": 3,
        }  # fmt: skip

    _write_edited(folder, change)
    before, images = (folder / "poses.json").read_bytes(), sorted(folder.glob("*.png"))
    write_poses(_scaled(2, images), folder / "poses.json")
    content, views = _content(folder), _load(folder)
    assert [views[name].cam2world[0, 3].item() for name in "abcde"] == [0, 2, 4, 6, 8]
    assert content == content | {"near": 0.2, "far": 5, "author": {"name": "me"}}
    assert (views["b"].title, views["b"].mask) == ("Bath", folder / "own.jpg")
    assert content["poses"]["b.png"]["note"] == 3
    assert (content["worlds"][0]["unit"], content["worlds"][0]["note"]) == (3.2, 7)
    assert (folder / "poses.json.bak").read_bytes() == before
    pair = pansplat.load_sets(folder)[0]
    assert (pair.near, pair.far) == (0.2, 5)


def test_the_same_estimate_changes_no_file(folder: Path):
    images = sorted(folder.glob("*.png"))
    for _ in range(2):
        write_poses(_estimate(images), folder / "poses.json")
        assert not (folder / "poses.json.bak").exists()


def test_backups_are_not_replaced(folder: Path):
    images, written = sorted(folder.glob("*.png")), []
    for factor in (1, 2, 3):
        write_poses(_scaled(factor, images), folder / "poses.json")
        written.append((folder / "poses.json").read_bytes())
    assert [(folder / f"poses.json.bak{number}").read_bytes() for number in ("", 1)] == written[:2]


def _measure(content: dict) -> None:
    content["poses"]["b.png"][0][3] = 1.25


def test_measured_poses_hold_their_world_and_overwrite_replaces_them(folder: Path):
    _write_edited(folder, _measure)
    images = sorted(folder.glob("*.png"))
    with pytest.warns(UserWarning, match=r"keeps its poses of a\.png, b\.png, .*`--overwrite` replaces them"):
        write_poses(_scaled(2, images), folder / "poses.json")
    assert [_load(folder)[name].cam2world[0, 3].item() for name in "abcde"] == [0, 1.25, 2, 3, 4]
    before = (folder / "poses.json").read_bytes()
    write_poses(_scaled(2, images), folder / "poses.json", overwrite=True)
    assert [_load(folder)[name].cam2world[0, 3].item() for name in "abcde"] == [0, 2, 4, 6, 8]
    assert before in [file.read_bytes() for file in folder.glob("poses.json.bak*")]


def test_poses_of_a_file_of_another_program_are_kept_in_its_convention(folder: Path):
    pose = np.diag((1.0, -1, -1, 1))
    pose[:3, 3] = 7, 0, 0
    stated = {"convention": "cam2world opengl", "poses": {"a.png": pose.tolist()}, "rooms": 3}
    (folder / "poses.json").write_text(json.dumps(stated))
    write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    content = _content(folder)
    assert content["rooms"] == 3 and content["poses"]["a.png"] == stated["poses"]["a.png"]
    views = _load(folder)
    assert np.allclose([views[name].cam2world[0, 3].item() for name in "abcde"], (7, 8, 9, 10, 11))
    assert len({views[name].world for name in "abcde"}) == 1


def _measure_some(folder: Path, places: dict[str, float]) -> None:
    """A file of another program, without the unit of an estimate, with cameras at these places along x."""
    poses = {f"{name}.png": np.eye(4) for name in places}
    for name, x in places.items():
        poses[f"{name}.png"][0, 3] = x
    stated = {"convention": "cam2world opencv", "poses": {name: pose.tolist() for name, pose in poses.items()}}
    (folder / "poses.json").write_text(json.dumps(stated))


def test_new_panoramas_have_the_scale_of_the_distances_between_measured_ones(folder: Path, recwarn):
    """The estimate has 1 m between neighbours; the file has 2.7 units by the median of 3.1, 2.7 and 2.5."""
    _measure_some(folder, {"a": 6.9, "b": 10.0, "d": 15.0})
    write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    assert _load(folder)["e"].cam2world[0, 3].item() == pytest.approx(17.7)
    assert not [warning for warning in recwarn if "does not state a scale" in str(warning.message)]


def test_a_single_measured_pose_states_no_scale_and_a_warning_says_what_to_do(folder: Path):
    _measure_some(folder, {"a": 7.0})
    with pytest.warns(UserWarning, match=r"only one measured pose, of a\.png, .*--baseline or --camera-height"):
        write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json")
    assert _load(folder)["b"].cam2world[0, 3].item() == pytest.approx(8.0)


def test_what_cannot_be_placed_beside_replaced_poses_keeps_its_own_in_another_world(folder: Path):
    """a was measured with b, and is not placed now: with --overwrite it stays as it is, where nothing else is."""
    _write_edited(folder, lambda content: (_measure(content), content["poses"]["a.png"][2].__setitem__(3, 0.5)))
    write_poses(_scaled(2, sorted(folder.glob("*.png")), start=1), folder / "poses.json", overwrite=True)
    views = _load(folder)
    assert views["a"].cam2world[2, 3] == 0.5 and views["a"].world != views["b"].world
    assert [views[name].cam2world[0, 3].item() for name in "bcde"] == [2, 4, 6, 8]


def test_an_estimated_pose_that_is_not_found_again_goes_and_its_room_stays(folder: Path):
    def change(content: dict) -> None:
        content["poses"]["a.png"] = {"cam2world": content["poses"]["a.png"], "room": "Hall"}

    _write_edited(folder, change)
    write_poses(_scaled(2, sorted(folder.glob("*.png")), start=2), folder / "poses.json")
    views = _load(folder)
    assert "b.png" not in _content(folder)["poses"]
    assert views["a"].title == "Hall" and views["b"].placement.reason == "no wall"
    assert len({views[name].world for name in "ac"}) == 2


def test_poses_of_panoramas_that_are_not_read_stay_and_hold_the_others(folder: Path):
    images = sorted(folder.glob("*.png"))
    write_poses(_estimate(images[:4]), folder / "poses.json")
    write_poses(_scaled(1, images[2:]), folder / "poses.json")  # c is at the origin here
    views = _load(folder)
    assert [views[name].cam2world[0, 3].item() for name in "abcdef"] == [0, 1, 2, 3, 4, 5]
    assert len({view.world for view in views.values()}) == 1


def test_a_panorama_that_was_removed_does_not_hold_the_others(folder: Path):
    images = sorted(folder.glob("*.png"))
    write_poses(_estimate(images), folder / "poses.json")
    images[4].unlink()
    write_poses(_scaled(2, images[:4]), folder / "poses.json")
    assert [_load(folder)[name].cam2world[0, 3].item() for name in "abcd"] == [0, 2, 4, 6]
    assert "e.png" not in _content(folder)["poses"]


def test_the_first_change_by_hand_keeps_the_old_file(folder: Path):
    _write_edited(folder, _measure)
    before, editor = (folder / "poses.json").read_bytes(), _edit(folder)
    for name in "bc":
        editor.place({folder / f"{name}.png": np.eye(4)}, 0)
    assert [file.read_bytes() for file in folder.glob("poses.json.bak*")] == [before]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"poses": ', r"poses\.json: needed JSON"),
        ({"poses": {}}, 'needed a pose "convention"'),
        ({"convention": "cam2world opencv", "poses": {}, "worlds": [3]}, r"worlds, \[0\]: needed an object"),
        ({"convention": "cam2world opencv", "poses": {"a.png": {"room": "x"}}}, "a.png.*needed a pose"),
    ],
)
def test_a_faulty_file_is_named_and_kept(folder: Path, content: dict, message: str):
    editor, text = _edit(folder), json.dumps(content) if isinstance(content, dict) else content
    (folder / "poses.json").write_text(text)
    for write in (
        lambda: write_poses(_estimate(sorted(folder.glob("*.png"))), folder / "poses.json"),
        lambda: editor.place({folder / "f.png": np.eye(4)}, 0),
    ):
        expect_error(message, write)
    assert (folder / "poses.json").read_text() == text and not (folder / "poses.json.bak").exists()
