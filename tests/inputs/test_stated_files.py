"""The contract of all files that state panoramas: cut, changed, too large, with missing pictures or ones elsewhere."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.errors import InputError
from pansplat.images.image_files import list_pictures
from pansplat.images.rig_images import Lens, RigImage, RigView, write_rig
from pansplat.inputs.folders import load_pairs
from pansplat.inputs.stated_files import find_inside, locate_inside

OUTSIDE = "needed a file inside .*room, got the path"


def write_picture(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((64, 128, 3), 90, np.uint8)).save(path)


def _move(step: int) -> list[list[float]]:
    return (np.eye(4) + step * np.eye(4, k=3)).tolist()


def state_nerfstudio(folder: Path, names: list[str]) -> None:
    frames = [{"file_path": name, "transform_matrix": _move(n)} for n, name in enumerate(names)]
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))


def state_colmap(folder: Path, names: list[str]) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 EQUIRECTANGULAR 128 64 128 64\n")
    lines = [f"{n} 1 0 0 0 {n} 0 0 1 {name}\n\n" for n, name in enumerate(names)]
    (model / "images.txt").write_text("".join(lines))


def _state_openmvg(folder: Path, root: str, names: list[str]) -> None:
    def view(number: int, name: str) -> dict[str, object]:
        data = {"local_path": "", "filename": name, "id_view": number, "id_intrinsic": 0, "id_pose": number}
        return {"key": number, "value": {"ptr_wrapper": {"data": data}}}

    content = {
        "root_path": root,
        "views": [view(n, name) for n, name in enumerate(names)],
        "intrinsics": [{"key": 0, "value": {"polymorphic_id": 1 << 31, "polymorphic_name": "spherical"}}],
        "extrinsics": [{"key": n, "value": {"rotation": np.eye(3).tolist(), "center": [n, 0, 0]}} for n in range(9)],
        "structure": [],
    }
    (folder / "sfm_data.json").write_text(json.dumps(content))


def state_openmvg(folder: Path, names: list[str]) -> None:
    _state_openmvg(folder, "", names)


def state_openmvg_root(folder: Path, names: list[str]) -> None:
    """The names are inside of a root that is not."""
    outside = [name for name in names if Path(name).name == "secret.png"]
    root = str(Path(outside[0]).parent) if outside else "."
    _state_openmvg(folder, root, [Path(name).name for name in names])


def state_opensfm(folder: Path, names: list[str]) -> None:
    shots = {name: {"rotation": [0, 0, 0], "translation": [n, 0, 0], "camera": "c"} for n, name in enumerate(names)}
    part = {"cameras": {"c": {"projection_type": "spherical"}}, "shots": shots}
    (folder / "reconstruction.json").write_text(json.dumps([part]))


def state_metashape(folder: Path, names: list[str]) -> None:
    cameras = "".join(
        f'<camera id="{n}" sensor_id="0" label="{name}"><transform>{" ".join(map(str, np.ravel(_move(n))))}'
        "</transform></camera>"
        for n, name in enumerate(names)
    )
    sensor = '<sensors><sensor id="0" type="spherical"/></sensors>'
    (folder / "c.xml").write_text(f"<document><chunk>{sensor}<cameras>{cameras}</cameras></chunk></document>")


RECONSTRUCTIONS = [
    state_nerfstudio, state_colmap, state_openmvg, state_openmvg_root, state_opensfm, state_metashape,
]  # fmt: skip


def state_poses(folder: Path, names: list[str]) -> None:
    entries = {name: _move(n) for n, name in enumerate(names)}
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": entries}))


def state_mask(folder: Path, names: list[str]) -> None:
    entries = {name: {"cam2world": _move(n)} for n, name in enumerate(names[:2])}
    entries[names[0]]["mask"] = names[-1]
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": entries}))


def state_depth(folder: Path, names: list[str]) -> None:
    state_mask(folder, names)
    (folder / "poses.json").write_text((folder / "poses.json").read_text().replace('"mask"', '"depth"'))


def state_frames(folder: Path, names: list[str]) -> None:
    (folder / "camera_pose.json").write_text(json.dumps({name: _move(n) for n, name in enumerate(names)}))


def state_frame_mask(folder: Path, names: list[str]) -> None:
    state_nerfstudio(folder, names[:2])
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = names[-1]
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A folder of two panoramas beside a picture that is not in it."""
    write_picture(tmp_path / "secret.png")
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / "room" / name)
    return tmp_path / "room"


def read(folder: Path) -> tuple[set[str], str]:
    """The files that panoramas of a folder are made from, and the notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        views = [view for pair in load_pairs(folder) for view in (*pair.context, *pair.targets)]
    files = [file for view in views for file in (*list_pictures(view.image), view.mask, view.depth) if file]
    return {file.resolve().name for file in files}, " ".join(str(warning.message) for warning in caught)


@pytest.mark.parametrize("outside", ["../secret.png", "x/../../secret.png", "{}/secret.png", "..\\secret.png"])
@pytest.mark.parametrize("state", RECONSTRUCTIONS)
def test_pictures_that_lead_out_of_a_reconstruction_are_left_out_with_a_note(
    room: Path, state: Callable[[Path, list[str]], None], outside: str
) -> None:
    state(room, ["a.png", "b.png", outside.format(room.parent).replace("\\", "/")])
    files, notes = read(room)
    assert files == {"a.png", "b.png"}
    assert "secret.png" in notes and "out of which no path is followed" in notes


@pytest.mark.parametrize("outside", ["../secret.png", "x/../../secret.png", "{}/secret.png"])
@pytest.mark.parametrize("state", [state_poses, state_mask, state_depth, state_frames, state_frame_mask])
def test_lists_that_lead_out_of_their_folder_are_refused(
    room: Path, state: Callable[[Path, list[str]], None], outside: str
) -> None:
    state(room, ["a.png", "b.png", outside.format(room.parent)])
    with pytest.raises(InputError, match=OUTSIDE):
        read(room)


def state_kitti(folder: Path, names: list[str]) -> None:
    lines = (" ".join(map(str, np.ravel(_move(n)[:3]))) for n in range(len(names)))
    (folder / "poses.kitti").write_text("\n".join(lines))
    (folder / "scale.txt").write_text("1")


def state_tum(folder: Path, names: list[str]) -> None:
    (folder / "poses.tum").write_text("\n".join(f"{n} {n} 0 0 0 0 0 1" for n in range(len(names))))
    (folder / "scale.txt").write_text("1")


def state_panogrf(folder: Path, names: list[str]) -> None:
    for n, name in enumerate(names):
        view = folder / Path(name).stem
        view.mkdir()
        if (folder / name).is_file():
            (folder / name).rename(view / "rgb.png")
        np.savetxt(view / "rot.txt", np.eye(3))
        np.savetxt(view / "tran.txt", [n, 0, 0])


READERS = {  # the file that states poses or panoramas, and whether it names pictures
    state_nerfstudio: ("transforms.json", True),
    state_colmap: ("sparse/0/images.txt", True),
    state_openmvg: ("sfm_data.json", True),
    state_opensfm: ("reconstruction.json", True),
    state_metashape: ("c.xml", True),
    state_poses: ("poses.json", True),
    state_frames: ("camera_pose.json", False),
    state_kitti: ("poses.kitti", False),
    state_tum: ("poses.tum", False),
    state_panogrf: ("b/tran.txt", False),
}
contract = pytest.mark.parametrize(("state", "stated"), [(state, stated) for state, (stated, _) in READERS.items()])


def read_or_refuse(folder: Path, stated: str) -> None:
    """Panoramas of the folder are read, or the file is named."""
    try:
        files, notes = read(folder)
    except InputError as error:
        assert Path(stated).stem in str(error) or str(Path(stated).parent) in str(error), error
    else:
        assert files <= {"a.png", "b.png", "rgb.png"} and (files in ({"a.png", "b.png"}, {"rgb.png"}) or notes)


@contract
def test_a_file_is_read_and_one_that_is_cut_or_changed_is_read_or_named(
    room: Path, state: Callable[[Path, list[str]], None], stated: str
) -> None:
    state(room, ["a.png", "b.png"])
    assert read(room)[0] in ({"a.png", "b.png"}, {"rgb.png"})
    content, random = (room / stated).read_bytes(), np.random.default_rng(0)
    for end in (0, 1, len(content) // 3, 2 * len(content) // 3, len(content) - 2):
        (room / stated).write_bytes(content[:end])
        read_or_refuse(room, stated)
    for _ in range(20):
        changed = bytearray(content)
        for place in random.integers(0, len(content), 3):
            changed[place] = random.integers(0, 256)
        (room / stated).write_bytes(changed)
        read_or_refuse(room, stated)


@contract
def test_a_file_that_is_too_large_is_named_and_not_read(
    room: Path, state: Callable[[Path, list[str]], None], stated: str
) -> None:
    state(room, ["a.png", "b.png"])
    os.truncate(room / stated, 1 << 32)  # without blocks on the disk
    with pytest.raises(InputError, match=rf"{re.escape(Path(stated).name)}.* of at most [\d,]+ bytes, got 4,294"):
        read(room)


@pytest.mark.parametrize("state", [state for state, (_, names) in READERS.items() if names])
def test_a_picture_that_is_missing_is_named_and_the_others_are_read(
    room: Path, state: Callable[[Path, list[str]], None]
) -> None:
    state(room, ["a.png", "b.png", "gone.png"])
    files, notes = read(room)
    assert files == {"a.png", "b.png"} and "gone" in notes


@pytest.mark.parametrize("state", [state_kitti, state_tum, state_panogrf])
def test_fewer_pictures_than_poses_are_refused(room: Path, state: Callable[[Path, list[str]], None]) -> None:
    state(room, ["a.png", "b.png", "gone.png"])
    with pytest.raises(InputError, match=r"needed (one pose per image \(2 images\), got 3|rgb\.png next to)"):
        read(room)


def test_two_trajectories_of_one_folder_are_refused(room: Path) -> None:
    state_kitti(room, ["a.png", "b.png"])
    state_tum(room, ["a.png", "b.png"])
    with pytest.raises(InputError, match=r"needed one trajectory file, got poses\.kitti, poses\.tum"):
        read(room)


def test_whole_paths_inside_of_the_folder_are_read(room: Path) -> None:
    write_picture(room / "c" / "c.png")
    names = [str(room / "a.png"), str(room / "c" / ".." / "b.png"), "c/c.png"]
    for state in (state_poses, *RECONSTRUCTIONS[:3]):
        state(room, names)
        assert read(room)[0] == {"a.png", "b.png", "c.png"}
        next(room.glob("*.json"), room / "sparse").rename(room.parent / state.__name__)


def test_points_outside_of_the_folder_are_not_read(room: Path) -> None:
    lines = "\n".join(f"{x} 0 0" for x in range(200))
    (room.parent / "points.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 200\n{''.join(f'property float {a}' + chr(10) for a in 'xyz')}"
        f"end_header\n{lines}\n"
    )
    state_nerfstudio(room, ["a.png", "b.png"])
    content = json.loads((room / "transforms.json").read_text())
    (room / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "../points.ply"}))
    with pytest.raises(InputError, match=OUTSIDE):
        read(room)


def test_pairs_and_links_open_no_files(room: Path) -> None:
    """Their names are those of panoramas that have been read."""
    state_poses(room, ["a.png", "b.png"])
    (room / "links.json").write_text(json.dumps({"../secret.png": [], "a.png": [{"to": "../secret.png", "yaw": 0}]}))
    files, notes = read(room)
    assert files == {"a.png", "b.png"} and notes.count("../secret.png") == 2
    pairs = [{"context": ["a.png", "b.png"]}, {"context": ["a.png", "../secret.png"]}]
    (room / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    with pytest.raises(InputError, match=r"needed images that have a pose in poses\.json, got '\.\./secret\.png'"):
        read(room)


@pytest.mark.parametrize("state", [state_poses, state_frames])
def test_descriptions_of_assembled_panoramas_are_no_pictures_of_lists(
    room: Path, state: Callable[[Path, list[str]], None]
) -> None:
    """Such a file names pictures by whole paths; only those that pansplat writes into its cache are read."""
    view = RigView(room.parent / "secret.png", tuple(map(tuple, np.eye(3).tolist())), Lens(64, 64, 64, 32, 128, 64))
    write_rig(RigImage((view,)), room, "x").rename(room / "x.rig.json")
    state(room, ["a.png", "b.png", "x.rig.json"])
    with pytest.raises(InputError, match=OUTSIDE):
        read(room)


def test_a_path_inside_is_normal_and_one_outside_is_none(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    assert locate_inside(tmp_path, "b/../a") == tmp_path / "a" == find_inside(tmp_path, "b/../a")
    assert find_inside(tmp_path, "b") is None  # no such file
    for name in ("..", "../x", "/", "a/../../x", "x\0", str(tmp_path.parent / "a")):
        assert find_inside(tmp_path, name) is None
        with pytest.raises(InputError, match="needed a file inside"):
            locate_inside(tmp_path, name)
