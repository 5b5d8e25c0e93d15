"""A note that the window writes is read again, whatever the format of the panoramas."""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.errors import InputError
from pansplat.inputs import folders, reconstructions
from pansplat.inputs.folders import list_stated_files, load_panoramas
from pansplat.inputs.pairs import Note, Panorama
from pansplat.inputs.photographs import write_notes

NAMES = ("a.png", "b.png")
_IDENTITY = np.eye(4).tolist()
_SPHERICAL = {"polymorphic_id": 1 << 31, "polymorphic_name": "spherical", "ptr_wrapper": {"data": {}}}
_CAMERA = '<camera sensor_id="0" label="{}"><transform>1 0 0 {} 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>'

pytestmark = pytest.mark.filterwarnings("ignore::pansplat.errors.InputWarning")


def _picture(path: Path, seed: int = 0, size: tuple[int, int] = (8, 16)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (*size, 3), np.uint8)).save(path)


def _pictures(folder: Path, **files: object) -> Path:
    """Two panoramas and files of text, bytes or JSON; "__" in their keywords is the dot of the name."""
    for seed, name in enumerate(NAMES):
        _picture(folder / name, seed)
    for key, content in files.items():
        text = content if isinstance(content, (bytes, str)) else json.dumps(content)
        (folder / key.replace("__", ".")).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def _poses(folder: Path) -> Path:
    return _pictures(folder, poses__json={"convention": "cam2world opencv", "poses": dict.fromkeys(NAMES, _IDENTITY)})


def _poses_of_equal_names(folder: Path) -> Path:
    for seed, floor in enumerate(("up", "down")):
        _picture(folder / floor / "hall.png", seed)
    poses = dict.fromkeys(("up/hall.png", "down/hall.png"), _IDENTITY)
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    return folder


def _faces(folder: Path) -> Path:
    for name in ("hall", "bath"):
        for seed, face in enumerate("frblud"):
            _picture(folder / f"{name}_{face}.png", seed, (8, 8))
    return folder


def _panogrf(folder: Path) -> Path:
    for seed, view in enumerate(("00", "01")):
        _picture(folder / view / "rgb.png", seed)
        np.savetxt(folder / view / "rot.txt", np.eye(3))
        np.savetxt(folder / view / "tran.txt", [0, 0, seed])
    return folder


def _triplets(folder: Path) -> Path:
    for name in ("map_0", "map_1"):
        for seed in range(3):
            _picture(folder / f"{name}_{seed}.png", seed)
        (folder / f"{name}.json").write_text(json.dumps({"c2w": [_IDENTITY] * 3}))
    return folder


def _nerfstudio(folder: Path) -> Path:
    frames = [{"file_path": name, "transform_matrix": _IDENTITY} for name in NAMES]
    return _pictures(folder, transforms__json={"camera_model": "EQUIRECTANGULAR", "frames": frames})


def _nerfstudio_faces(folder: Path) -> Path:
    frames = []
    for name in ("hall", "bath"):
        for seed, (turn, up) in enumerate(((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))):
            a, b = math.radians(turn), math.radians(up)
            across = np.array(((math.cos(a), 0, math.sin(a)), (0, 1, 0), (-math.sin(a), 0, math.cos(a))))
            tilt = np.array(((1, 0, 0), (0, math.cos(b), -math.sin(b)), (0, math.sin(b), math.cos(b))))
            pose = np.eye(4)
            pose[:3, :3], pose[0, 3] = across @ tilt, name == "hall"
            _picture(folder / f"{name}_{seed}.png", seed, (8, 8))
            frames.append({"file_path": f"{name}_{seed}.png", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "OPENCV", "fl_x": 4, "fl_y": 4, "cx": 4, "cy": 4, "w": 8, "h": 8}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def _openmvg(folder: Path) -> Path:
    views = [{"filename": name, "id_intrinsic": 0, "id_pose": pose} for pose, name in enumerate(NAMES)]
    poses = [{"key": pose, "value": {"rotation": np.eye(3).tolist(), "center": [0, 0, pose]}} for pose in (0, 1)]
    content = {
        "views": [{"value": {"ptr_wrapper": {"data": view}}} for view in views],
        "intrinsics": [{"key": 0, "value": _SPHERICAL}],
        "extrinsics": poses,
        "structure": [],
    }
    return _pictures(folder, sfm_data__json=content)


def _opensfm(folder: Path) -> Path:
    shots = {name: {"rotation": [0, 0, 0], "translation": [x, 0, 0], "camera": "c"} for x, name in enumerate(NAMES)}
    content = [{"cameras": {"c": {"projection_type": "spherical"}}, "shots": shots, "points": {}}]
    return _pictures(folder, reconstruction__json=content)


def _metashape(folder: Path) -> Path:
    cameras = _CAMERA.format("a", 0) + _CAMERA.format("b", 1)
    sensor = '<sensor id="0" type="spherical"/>'
    return _pictures(folder, cameras__xml=f"<document><chunk>{sensor}{cameras}</chunk></document>")


def _colmap(folder: Path) -> Path:
    lines = "".join(f"{number} 1 0 0 0 {number} 0 0 1 {name}\n\n" for number, name in enumerate(NAMES))
    (folder / "sparse").mkdir(parents=True)
    (folder / "sparse" / "images.txt").write_text(lines)
    (folder / "sparse" / "cameras.txt").write_text("1 EQUIRECTANGULAR 16 8 16 8\n")
    return _pictures(folder)


def _colmap_binary(folder: Path) -> Path:
    images = b"".join(
        struct.pack("<I7dI6sQ", number, 1, 0, 0, 0, number, 0, 0, 1, name.encode(), 0)
        for number, name in enumerate(NAMES)
    )
    camera = struct.pack("<QIiQQ2d", 1, 1, 17, 16, 8, 16, 8)
    return _pictures(folder, images__bin=struct.pack("<Q", 2) + images, cameras__bin=camera)


def _kitti(folder: Path) -> Path:
    return _pictures(folder, poses__txt="1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n")


def _tum(folder: Path) -> Path:
    return _pictures(folder, walk__tum="0 0 0 0 0 0 0 1\n1 0.5 0 0 0 0 0 1\n")


def _loc360(folder: Path) -> Path:
    return _pictures(folder, camera_pose__json=dict.fromkeys(NAMES, _IDENTITY))


def _marzipano(folder: Path) -> Path:
    level = [{"tileSize": 8, "size": 8}]
    for scene in ("0-hall", "1-bath"):
        for seed, face in enumerate("frblud"):
            _picture(folder / "tiles" / scene / "0" / face / "0" / "0.jpg", seed, (8, 8))
    scenes = [{"id": name, "name": "Hall", "levels": level} for name in ("0-hall", "1-bath")]
    (folder / "data.js").write_text(f"var APP_DATA = {json.dumps({'scenes': scenes})};")
    (folder / "index.html").write_text("<!DOCTYPE html><script src='data.js'></script>")
    return folder


def _marzipano_root(folder: Path) -> Path:
    _marzipano(folder / "app-files")
    return folder


def _marzipano_root_with_poses(folder: Path) -> Path:
    poses = dict.fromkeys(("0-hall", "1-bath"), _IDENTITY)
    _marzipano_root(folder)
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    return folder


def _marzipano_page(folder: Path) -> Path:
    (_marzipano_root(folder) / "index.html").write_text("<!DOCTYPE html>")
    return folder / "index.html"


def _pannellum(folder: Path) -> Path:
    scenes = {name: {"panorama": f"{name}.png"} for name in ("a", "b")}
    return _pictures(folder, tour__json={"scenes": scenes})


FORMATS: dict[str, Callable[[Path], Path]] = {
    "read_pose_file_folder": _poses,
    "read_pose_file_folder, equal names": _poses_of_equal_names,
    "read_loc360_sequence": _loc360,
    "read_matterport3d_scene": _panogrf,
    "read_triplet": _triplets,
    "read_trajectory_folder, KITTI": _kitti,
    "read_trajectory_folder, TUM": _tum,
    "read_reconstruction, transforms.json": _nerfstudio,
    "read_reconstruction, cube faces": _nerfstudio_faces,
    "read_reconstruction, sfm_data.json": _openmvg,
    "read_reconstruction, reconstruction.json": _opensfm,
    "read_reconstruction, COLMAP text": _colmap,
    "read_reconstruction, COLMAP binary": _colmap_binary,
    "read_reconstruction, Metashape": _metashape,
    "read_web_tour, Pannellum": _pannellum,
    "read_web_tour, Marzipano": _marzipano,
    "read_web_tour, Marzipano by its root": _marzipano_root,
    "read_web_tour, Marzipano by its root with poses": _marzipano_root_with_poses,
    "read_web_tour, Marzipano by its page": _marzipano_page,
    "photographs": _pictures,
    "cube faces": _faces,
}


def test_the_formats_are_all_that_are_read() -> None:
    readers = {name for name in vars(folders) if name.startswith("read_")} - {"read_photograph"}  # of a file alone
    assert readers <= {name.split(",")[0] for name in FORMATS}
    assert all(any(file in name for name in FORMATS) for file in reconstructions._READERS)


def _read(path: Path) -> dict[Path, Panorama]:
    return {panorama.image: panorama for panorama in load_panoramas(path)}


@pytest.mark.parametrize("kind", FORMATS)
def test_a_note_that_is_written_is_read_again(tmp_path: Path, kind: str) -> None:
    path = FORMATS[kind](tmp_path / "tour")
    notes: dict[Path, tuple[Note, ...]] = {image: () for image in _read(path)}
    assert len(notes) >= 2 and all(not panorama.notes for panorama in _read(path).values())
    for number, image in enumerate(notes):
        notes[image] = (Note(0.5, -0.25, f"note {number}"),)
        file = write_notes(_read(path)[image], notes[image])
        assert file in list_stated_files(path if path.is_dir() else path.parent), "the window watches it"
        assert {image: panorama.notes for image, panorama in _read(path).items()} == notes
    for image in notes:  # again, now that there are entries
        notes[image] += (Note(1.5, 0.25, "second"),)
        write_notes(_read(path)[image], notes[image])
    assert {image: panorama.notes for image, panorama in _read(path).items()} == notes


def test_notes_of_a_marzipano_tour_are_the_same_however_it_is_opened(tmp_path: Path) -> None:
    root = _marzipano_root(tmp_path)
    first, second = load_panoramas(root)
    (root / "links.json").write_text(json.dumps({"0-hall": {"title": "Ours", "notes": [{"yaw": 1, "text": "lost"}]}}))
    write_notes(second, [Note(0.5, 0, "sofa")])
    for path in (root / "app-files", root / "app-files" / "data.js", root / "app-files" / "index.html"):
        assert [panorama.notes for panorama in load_panoramas(path)] == [(), (Note(0.5, 0, "sofa"),)]
    assert [panorama.notes for panorama in load_panoramas(root)] == [(Note(1, 0, "lost"),), (Note(0.5, 0, "sofa"),)]
    assert load_panoramas(root)[0].label == "Ours" and first.notes == ()


def test_a_name_of_several_panoramas_is_refused_in_links(tmp_path: Path) -> None:
    folder = _poses_of_equal_names(tmp_path)
    links = {"hall": {"title": "both"}, "up/hall.png": {"title": "one", "links": [{"to": "hall", "yaw": 0}]}}
    (folder / "links.json").write_text(json.dumps(links))
    with pytest.warns(match="'hall' is left out: it is the name of several panoramas; give the path"):
        panoramas = load_panoramas(folder)
    assert sorted(panorama.label for panorama in panoramas) == ["hall", "one"]


def test_a_panorama_opened_alone_has_no_file_for_notes(tmp_path: Path) -> None:
    (panorama,) = load_panoramas(_pictures(tmp_path) / "a.png")
    with pytest.raises(InputError, match=r"a\.png: needed a panorama of a folder .* open its folder"):
        write_notes(panorama, [Note(0, 0, "sofa")])
