"""Every folder format gives the same cameras, and invalid folders are refused with the reason."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from panorama_fixtures import write_depth_image, write_grey
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.images.image_files import write_image
from pansplat.inputs.folders import find_panorama_folders, load_collections, load_sets, make_names_unique
from pansplat.inputs.panorama_sets import Link

OPENCV = "cam2world opencv"


def _pose(x: float, z: float = 0.0) -> list[list[float]]:
    return [[0, 0, 1, x], [0, 1, 0, 0], [-1, 0, 0, z], [0, 0, 0, 1]]


def _folder(folder: Path, names: Sequence[str] = ("left.png", "right.png"), **content: object) -> Path:
    """A pair folder whose i-th camera is at x = i; `content` goes into poses.json, None removes an entry."""
    for i, name in enumerate(names):
        write_grey(folder / name, 0.1 * (i + 1))
    poses = {"convention": OPENCV, "poses": {name: _pose(i) for i, name in enumerate(names)}} | content
    (folder / "poses.json").write_text(json.dumps({k: v for k, v in poses.items() if v is not None}))
    return folder


def test_two_images_with_poses_are_a_pair(tmp_path: Path) -> None:
    (pair,) = load_sets(_folder(tmp_path / "room"))
    assert pair.name == "room"
    assert [panorama.name for panorama in pair.context] == ["left", "right"]
    assert (pair.targets, pair.near, pair.far) == ((), 0.45, 10.0)
    views = pair.load_context(8)
    assert views.images.shape == (2, 3, 8, 16)
    assert views.images.mean(dim=(1, 2, 3)).tolist() == pytest.approx([0.1, 0.2], abs=3e-3)
    assert views.cam2world.dtype == torch.float64
    assert views.cam2world.tolist() == [_pose(0), _pose(1)]
    assert views.masks.all()
    assert views.names == ("left", "right")
    assert views.depths is None
    assert pair.load_targets(8).images.shape == (0, 3, 8, 16)


def test_the_path_may_be_the_pose_file_and_pixels_are_decoded_only_by_load_context(tmp_path: Path, monkeypatch) -> None:
    folder = _folder(tmp_path / "room")
    monkeypatch.setattr("pansplat.images.image_files._decode", None)
    assert load_sets(folder / "poses.json")[0].name == load_sets(str(folder))[0].name == "room"


def test_a_damaged_picture_of_three_is_left_out_with_its_pairs(tmp_path: Path) -> None:
    names = ("left.png", "middle.png", "right.png")
    folder = _folder(tmp_path / "room", names)
    (folder / "middle.png").write_bytes((folder / "middle.png").read_bytes()[:-30])
    groups = [{"context": list(names[:2])}, {"context": ["left.png", "right.png"], "target": "middle.png"}]
    for pairs in (None, groups):
        if pairs is not None:
            (folder / "pairs.json").write_text(json.dumps({"pairs": pairs}))
        with pytest.warns(UserWarning, match=r"left out: .*middle\.png: needed a complete image"):
            (pair,) = load_sets(folder)
        assert [view.name for view in pair.context] == ["left", "right"] and not pair.targets
    write_image(folder / "middle.png", torch.full((3, 16, 24), 0.5))
    with pytest.warns(UserWarning, match=r"left out: .*middle\.png: needed a 2:1"):
        assert len(load_sets(folder)) == 1
    (folder / "left.png").write_bytes(b"")
    expect_error(r"left\.png: needed an image, got a file of 0 bytes", load_sets, folder)


def test_a_pair_has_depth_masks_range_and_targets(tmp_path: Path) -> None:
    names = ("left.png", "middle.png", "right.png")
    entries = {n: {"cam2world": _pose(i), "depth": f"{n[:-4]}_far.png"} for i, n in enumerate(names)}
    entries["left.png"]["mask"] = "own.png"
    folder = _folder(tmp_path / "room", names, poses=entries, near=0.2, far=30)
    for i, name in enumerate(names):
        write_depth_image(folder / f"{name[:-4]}_far.png", 1000 * (i + 1))
    mask = np.full((16, 32), 255, np.uint8)
    mask[8:] = 0
    cv2.imwrite(str(folder / "own.png"), mask)
    (folder / "pairs.json").write_text(json.dumps({"pairs": [{"context": [names[0], names[2]], "target": [names[1]]}]}))
    (pair,) = load_sets(folder)  # targets, masks and depth are no scenes of their own
    views, targets = pair.load_context(16), pair.load_targets(16)
    (stated,) = load_sets(folder, near=0.3, far=4)
    assert (views.near, views.far) == (0.2, 30.0) and (stated.near, stated.far) == (0.3, 4)
    assert views.depths is not None
    assert views.depths[:, 0, 0].tolist() == [1.0, 3.0]
    assert targets.names == ("middle",)
    assert not views.masks[0, 8:].any()
    assert views.masks[0, :8].all()
    assert views.masks[1].all()


def test_pairs_of_nested_folders_have_unique_names(tmp_path: Path) -> None:
    for name in ("b", "a", "c"):
        _folder(tmp_path / name / "room")
    pairs = load_sets(tmp_path)
    assert [pair.folder.parent.name for pair in pairs] == ["a", "b", "c"]
    assert len({pair.name for pair in pairs}) == 3
    pairs = [dataclasses.replace(pairs[0], name=name) for name in ("x", "x", "room_x_1", "room_x_2")]
    assert len({pair.name for pair in make_names_unique(pairs)}) == 4, "a numbered name may be that of another pair"


def test_without_pairs_file_panoramas_are_paired_along_the_spanning_tree(tmp_path: Path) -> None:
    names = [f"{i}.png" for i in range(4)]
    poses = {name: _pose(x) for name, x in zip(names, (0.0, 10.0, 1.0, 12.0), strict=True)}
    pairs = load_sets(_folder(tmp_path / "flat", names, poses=poses))
    assert [pair.name for pair in pairs] == ["0-2", "1-2", "1-3"]


@pytest.mark.parametrize("seed", range(3))
def test_pairs_of_a_grid_do_not_depend_on_the_rounding_of_its_poses(tmp_path: Path, seed: int) -> None:
    noise = np.random.default_rng(seed).normal(0, 1e-12, (9, 2))
    names = [f"{i}.png" for i in range(9)]
    poses = {name: _pose(*(divmod(i, 3) + noise[i])) for i, name in enumerate(names)}
    pairs = load_sets(_folder(tmp_path / "grid", names, poses=poses))
    assert [pair.name for pair in pairs] == ["0-1", "0-3", "1-2", "1-4", "2-5", "3-6", "4-7", "5-8"]


def test_triplets_come_first_and_contexts_are_unique(tmp_path: Path) -> None:
    names = ("a.png", "b.png", "c.png")
    folder = _folder(tmp_path / "flat", names)
    pairs = [{"context": ["a.png", "b.png"]}, {"context": ["a.png", "c.png"]}]
    triplets = [{"context": ["a.png", "c.png"], "target": "b.png"}]
    (folder / "pairs.json").write_text(json.dumps({"pairs": pairs, "triplets": triplets}))
    loaded = load_sets(folder)
    assert [(pair.name, [t.name for t in pair.targets]) for pair in loaded] == [("a-c", ["b"]), ("a-b", [])]


def test_panogrf_scenes_are_found_from_every_level_of_folders(tmp_path: Path) -> None:
    top = tmp_path / "mp3d"
    scene = top / "png_render_test_32x16_seq_len_3_m3d_dist_0.5" / "00000007"
    for i in range(3):
        view = scene / f"{i:02d}"
        write_grey(view / "rgb.png")
        write_depth_image(view / "depth.png", 2500)
        np.savetxt(view / "rot.txt", np.eye(3))
        np.savetxt(view / "tran.txt", [0, 0.5, 0.5 * (i - 1)])
    for path in (top, scene.parent, scene):
        (pair,) = load_sets(path)
        assert pair.name == "00000007"
        assert [panorama.name for panorama in (*pair.context, *pair.targets)] == ["00", "02", "01"]
    views = pair.load_context(16)
    assert views.depths is not None
    assert views.depths.unique().tolist() == [2.5]
    # Habitat's identity, in a z-up world: right is +x, down is -z, forward is +y (docs/official.md, section 2.1).
    assert views.cam2world[0].tolist() == [[1, 0, 0, 0], [0, 0, 1, 0.5], [0, -1, 0, 0.5], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"convention": None}, '"convention".*"cam2world opencv"'),
        ({"convention": "mine"}, "convention.*'mine'"),
        ({"poses": {}}, "poses"),
        ({"poses": {"left.png": _pose(0), "right.png": None}}, "'right.png'"),
        ({"poses": {"left.png": _pose(0), "gone.png": _pose(1)}}, "gone.png"),
        ({"poses": {"left.png": _pose(0), "right.png": {"room": "x"}}}, r"'right.png'.*\['room'\]"),
        ({"poses": {"left.png": _pose(0), "right.png": {"world2cam": _pose(1)}}}, "'right.png'.*\"world2cam\""),
        ({"poses": {"left.png": _pose(0), "right.png": {"pose": _pose(1), "mask": "m.png"}}}, "'right.png'.*m.png"),
        ({"near": 3, "far": 3}, "near=3 and far=3"),
        ({"near": 0}, "near=0"),
    ],
)
def test_invalid_pose_files_are_refused(tmp_path: Path, content: dict, message: str) -> None:
    folder = _folder(tmp_path / "room", **content)
    with pytest.raises(InputError, match=message) as caught:
        load_sets(folder)
    assert "poses.json" in str(caught.value)


def test_folders_without_panoramas_are_refused(tmp_path: Path) -> None:
    expect_error(r"needed panoramas .* got none; give the folder", load_sets, tmp_path)
    expect_error("got no such path", load_sets, tmp_path / "gone")
    _folder(tmp_path / "room")
    (tmp_path / "room" / "poses.json").write_text('{\n "convention": "cam2world opencv",\n}')
    expect_error(r"poses\.json: needed JSON, got invalid text at line [23]", load_sets, tmp_path / "room")
    write_grey(tmp_path / "flats" / "one" / "left.png")
    expect_error(r"flats: needed panoramas .* got some without poses in one", load_sets, tmp_path / "flats")
    (tmp_path / "note.txt").write_text("x")
    expect_error(r"note\.txt: .* got another file", load_sets, tmp_path / "note.txt")


def _check_single_view(pair, name: str, world: int = 0) -> None:
    (view,) = pair.context
    assert (pair.name, view.world, pair.targets) == (name, world, ())
    assert torch.equal(view.cam2world, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "exr"])
def test_one_panorama_is_a_pair_of_one_view(tmp_path: Path, suffix: str) -> None:
    image = tmp_path / "flat" / f"photo.{suffix}"
    write_grey(image, 0.25)
    for path, name in ((image, "photo"), (image.parent, "flat")):
        (pair,) = load_sets(path, near=0.3, far=5)
        _check_single_view(pair, name)
        assert (pair.near, pair.far, pair.folder) == (0.3, 5, image.parent)
    views = pair.load_context(8)
    assert views.images.mean() == pytest.approx(0.25, abs=0.01)
    assert views.masks.all() and views.names == ("photo",)


def test_panoramas_without_poses_are_listed_for_their_estimate(tmp_path: Path, write_scene) -> None:
    for number in range(3):
        write_scene(tmp_path / f"{number}.png", 8)
    expect_error(r"needed poses .* got images only \(0\.png, 1\.png, 2\.png\)", load_sets, tmp_path)
    (found,) = load_collections(tmp_path)
    assert found.needs_poses and found.folder == tmp_path
    assert [panorama.name for panorama in found.unposed] == ["0", "1", "2"]


def test_a_panorama_that_poses_do_not_list_is_a_scene_of_its_own(tmp_path: Path, write_scene) -> None:
    folder = _folder(tmp_path / "room")
    for name in ("attic.jpg", "cellar.png", ".hidden.png", "left_mask.png", "attic_depth.png"):
        write_scene(folder / name, 8)
    write_grey(folder / "film_frame.png")  # its metadata name pansplat as the software
    with pytest.warns(UserWarning, match=r"poses\.json has no pose of attic\.jpg, cellar\.png; each is a scene"):
        pair, attic, cellar = load_sets(folder)
    assert (pair.name, [view.world for view in pair.context]) == ("room", [0, 0])
    _check_single_view(attic, "attic", 1)
    _check_single_view(cellar, "cellar", 2)
    assert attic.context[0].mask is None
    names = ("attic.jpg", "cellar.png", "left.png", "right.png")
    assert attic.siblings == tuple(folder / name for name in names), "in file order"


def test_pictures_that_poses_name_are_panoramas_whoever_made_them(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "room")
    for name in ("frame.png", "taken.png", "view.png"):
        write_grey(folder / name)  # its metadata name pansplat as the software
    content = json.loads((folder / "poses.json").read_text())
    content |= {"estimate": {"unplaced": {"frame.png": "no door", "taken.png": "bare walls"}}}
    (folder / "poses.json").write_text(json.dumps(content))
    with pytest.warns(UserWarning, match=r"poses\.json has no pose of frame\.png, taken\.png; each is a scene"):
        _, frame, taken = load_sets(folder)
    assert [pair.context[0].placement.reason for pair in (frame, taken)] == ["no door", "bare walls"]


def test_panoramas_beside_posed_ones_in_subfolders_are_scenes_of_their_own(tmp_path: Path, write_scene) -> None:
    names = ("up/hall.png", "up/bath.png", "down/cellar.png")
    folder = _folder(tmp_path / "house", names)
    for name in ("up/attic.jpg", "down/hall.jpg", "loose.jpg"):
        write_scene(folder / name, 8)
    (folder / "links.json").write_text(json.dumps({"attic": [{"to": "down_hall", "yaw": 1}]}))
    with pytest.warns(UserWarning, match=r"poses\.json has no pose of loose\.jpg, attic\.jpg, hall\.jpg; each is"):
        *pairs, loose, attic, hall = load_sets(folder)
    assert len(pairs) == 2
    for number, (pair, name) in enumerate(((loose, "loose"), (attic, "attic"), (hall, "down_hall")), start=1):
        _check_single_view(pair, name, number)
    assert attic.context[0].links == (Link("down_hall", 1.0),)


def test_panoramas_of_other_folders_are_named_in_a_note(tmp_path: Path, write_scene) -> None:
    folder = _folder(tmp_path / "house" / "up")
    write_scene(folder / "more" / "attic.jpg", 8)
    write_scene(folder.parent / "garden.jpg", 8)
    write_scene(folder.parent / "old" / "img" / "hall.jpg", 8)
    (folder.parent / "old" / "tour.json").write_text(json.dumps({"panorama": "img/hall.jpg"}))
    with pytest.warns(UserWarning) as caught:
        (pair,) = load_sets(folder.parent)
    assert pair.name == "up"
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == 3
    assert f"{folder.parent}: panoramas are left out" in messages[0] and "garden.jpg" in messages[0]
    assert f"{folder.parent / 'old' / 'tour.json'} is another tour" in messages[1]
    assert f"{folder / 'more'}: panoramas are left out" in messages[2] and "attic.jpg" in messages[2]


def test_panoramas_below_or_beside_those_of_a_folder_without_poses_are_named(tmp_path: Path, write_scene) -> None:
    write_scene(tmp_path / "hall.jpg", 8)
    write_scene(tmp_path / "up" / "attic.jpg", 8)
    with pytest.warns(UserWarning, match=r"up: panoramas are left out, .*: attic\.jpg; open"):
        assert len(load_sets(tmp_path)) == 1
    (tmp_path / "tour.json").write_text(json.dumps({"panorama": "up/attic.jpg"}))
    with pytest.warns(UserWarning, match=r"panoramas are left out, .*: hall\.jpg; open"):
        assert load_sets(tmp_path)[0].context[0].image.name == "attic.jpg"


def test_posed_panoramas_in_no_pair_are_scenes_of_their_own(tmp_path: Path) -> None:
    names = ("left.png", "right.png", "attic.png")
    folder = _folder(tmp_path / "house", names)
    (folder / "pairs.json").write_text(json.dumps({"pairs": [{"context": list(names[:2])}]}))
    with pytest.warns(UserWarning, match=r"in no pair of pairs\.json, and each a scene of its own: attic\.png"):
        pair, attic = load_sets(folder)
    assert (pair.name, attic.name, attic.targets) == ("house", "attic", ())
    assert attic.context[0].cam2world.tolist() == _pose(2) and attic.context[0].world == 0


def test_pairs_of_panoramas_without_a_pose_are_left_out_with_a_note(tmp_path: Path, write_scene) -> None:
    folder = _folder(tmp_path / "house", ("a.png", "b.png", "c.png"))
    write_scene(folder / "d.jpg", 8)
    contexts = [["a.png", "d.jpg"], ["a.png", "b.png", "d.jpg"], ["b.png", "c.png"]]
    pairs = [{"context": context, "target": ["d.jpg"]} for context in contexts[:2]]
    (folder / "pairs.json").write_text(json.dumps({"pairs": [*pairs, {"context": contexts[2]}]}))
    with (
        pytest.warns(UserWarning, match=r"pairs\.json, .* pose in poses\.json: d\.jpg; pairs that need them: 1 of 3"),
        pytest.warns(UserWarning, match=r"poses\.json has no pose of d\.jpg; each is a scene of its own"),
    ):
        first, second, single = load_sets(folder)
    assert [[view.name for view in pair.context] for pair in (first, second, single)] == [["a", "b"], ["b", "c"], ["d"]]
    assert first.targets == second.targets == ()
    (folder / "pairs.json").write_text(json.dumps({"pairs": pairs[:1]}))
    with pytest.warns(UserWarning), pytest.raises(InputError, match=r"pairs 1: .* a pose in poses\.json, got 'd\.jpg'"):
        load_sets(folder)


def test_360loc_sequences_pair_frames_and_others_are_scenes_of_their_own(tmp_path: Path, write_scene) -> None:
    for i in range(3):
        write_grey(tmp_path / "image" / f"{i}.png")
    (tmp_path / "camera_pose.json").write_text(json.dumps({f"{i}.png": _pose(i) for i in range(3)}))
    write_scene(tmp_path / "image" / "lost.jpg", 8)
    write_scene(tmp_path / "loose.jpg", 8)
    with (
        pytest.warns(UserWarning, match=r"camera_pose\.json has no pose of lost\.jpg; each is a scene of its own"),
        pytest.warns(UserWarning, match=r"panoramas are left out, .*: loose\.jpg; open"),
    ):
        pairs = load_sets(tmp_path)
    assert [[float(view.cam2world[0, 3]) for view in pair.context] for pair in pairs[:2]] == [[0, 1], [1, 2]]
    assert pairs[0].far == 50
    _check_single_view(pairs[2], "lost", 1)


def test_other_pictures_of_a_posed_folder_are_named(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "room")
    cv2.imwrite(str(folder / "plan.png"), np.full((20, 30, 3), (9, 90, 200), np.uint8))
    cv2.imwrite(str(folder / "logo.png"), np.full((20, 20, 3), 90, np.uint8))
    with pytest.warns(UserWarning) as caught:
        (pair,) = load_sets(folder)
    assert pair.name == "room"
    (message,) = {str(warning.message) for warning in caught if "logo" in str(warning.message)}
    assert "logo.png: needed a 2:1 equirectangular panorama, got 20x20" in message


def test_poses_of_one_panorama_are_enough(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "room", ["only.png"])
    (pair,) = load_sets(folder)
    assert pair.name == "room" and pair.context[0].cam2world.tolist() == _pose(0)


def test_links_of_a_posed_folder_are_kept(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "room")
    links = {"left.png": [{"to": "right.png", "yaw": 1.5, "pitch": 0.2}], "right.png": {"title": "Kitchen"}}
    (folder / "links.json").write_text(json.dumps(links))
    for path in (folder, folder / "links.json"):
        (pair,) = load_sets(path)
        assert pair.context[0].links == (Link("right", 1.5, 0.2),)
        assert [view.label for view in pair.context] == ["left", "Kitchen"]


def test_rooms_of_poses_are_titles_unless_links_state_others(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "room")
    content = json.loads((folder / "poses.json").read_text())
    for name, pose in content["poses"].items():
        content["poses"][name] = (pose if isinstance(pose, dict) else {"cam2world": pose}) | {"room": " living\nroom"}
    content["poses"]["right.png"]["room"] = ["no text"]
    (folder / "poses.json").write_text(json.dumps(content))
    assert [view.label for view in load_sets(folder)[0].context] == ["living room", "right"]
    (folder / "links.json").write_text(json.dumps({"left.png": {"title": "Kitchen"}}))
    assert load_sets(folder)[0].context[0].label == "Kitchen"


def test_a_faulty_web_tour_gives_way_to_the_pictures_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "tour.json").write_text("<html>404</html>")
    expect_error(r"tour\.json: needed a tour of Pannellum .* got an HTML page", load_sets, tmp_path)
    write_grey(tmp_path / "hall.png")
    with pytest.warns(UserWarning, match=r"the web tour is left out: .*tour\.json"):
        (pair,) = load_sets(tmp_path)
    assert pair.context[0].name == "hall"


def test_a_web_tour_is_found_before_folders_below(tmp_path: Path, write_scene) -> None:
    write_scene(tmp_path / "tiles" / "hall.jpg", 8)
    (tmp_path / "tour.json").write_text(json.dumps({"title": "Hall", "panorama": "tiles/hall.jpg"}))
    _folder(tmp_path / "tiles" / "room")
    for path in (tmp_path, tmp_path / "tour.json"):
        (pair,) = load_sets(path)
        assert pair.name == tmp_path.name and pair.context[0].label == "Hall"
    assert find_panorama_folders(tmp_path) == [tmp_path]
