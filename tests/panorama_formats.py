"""An example of each format of panoramas, for the properties that all have in common."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

Names = Sequence[str]
_LENS = {"camera_model": "OPENCV", "fl_x": 4, "fl_y": 4, "cx": 4, "cy": 4, "w": 8, "h": 8}
_FACE_TURNS = ((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))  # to the right and up, degrees


def write_picture(path: Path, seed: int = 0, size: tuple[int, int] = (8, 16)) -> None:
    """A picture of noise, by default a panorama."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (*size, 3), np.uint8)).save(path)


def write_room(folder: Path, names: Names = ("a.png", "b.png")) -> Path:
    """A folder of panoramas."""
    for seed, name in enumerate(names):
        write_picture(folder / name, seed)
    return folder


def move(x: float) -> list[list[float]]:
    """The pose of a camera at x."""
    return (np.eye(4) + x * np.eye(4, k=3)).tolist()


def write_posed(
    folder: Path, pictures: dict[str, np.ndarray], places: Iterable[float], axis: int = 0, **fields: Any
) -> Path:
    """Pictures (H 2H 3) of cameras on an axis, and their poses.json with more fields."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = {}
    for (name, pixels), place in zip(pictures.items(), places, strict=True):
        Image.fromarray(pixels).save(folder / name)
        pose = np.eye(4)
        pose[axis, 3] = place
        poses[name] = {"cam2world": pose.tolist()}
    _write(folder / "poses.json", {"convention": "cam2world opencv", "poses": poses, **fields})
    return folder


def _write(path: Path, content: Any) -> None:
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def state_poses(folder: Path, names: Names) -> None:
    poses = {name: move(n) for n, name in enumerate(names)}
    world = {"near": 0.4, "far": 9.0, "unit": 1.5}
    _write(folder / "poses.json", {"convention": "cam2world opencv", "poses": poses, "worlds": [world]})


def _state_equal_names(folder: Path, names: Names) -> None:
    for sub, name in zip(("up", "down"), names, strict=False):
        (folder / sub).mkdir()
        (folder / name).rename(folder / sub / "hall.png")
    state_poses(folder, ["up/hall.png", "down/hall.png"])


def state_loc360(folder: Path, names: Names) -> None:
    _write(folder / "camera_pose.json", {name: move(n) for n, name in enumerate(names)})


def _state_panogrf(folder: Path, names: Names) -> None:
    for n, name in enumerate(names):
        view = folder / Path(name).stem
        view.mkdir()
        if (folder / name).is_file():
            (folder / name).rename(view / "rgb.png")
        np.savetxt(view / "rot.txt", np.eye(3))
        np.savetxt(view / "tran.txt", [n, 0, 0])


def _state_triplet(folder: Path, names: Names) -> None:
    for n, name in enumerate(names):
        if (folder / name).is_file():
            (folder / name).rename(folder / f"map_{n}.png")
    _write(folder / "map.json", {"c2w": [move(n) for n in range(len(names))]})


def state_nerfstudio(folder: Path, names: Names) -> None:
    frames = [{"file_path": name, "transform_matrix": move(n)} for n, name in enumerate(names)]
    _write(folder / "transforms.json", {"camera_model": "EQUIRECTANGULAR", "frames": frames})


def _state_rigs(folder: Path, names: Names) -> None:
    frames = []
    for n, name in enumerate(names):
        for seed, (turn, up) in enumerate(_FACE_TURNS):
            a, b = math.radians(turn), math.radians(up)
            across = np.array(((math.cos(a), 0, math.sin(a)), (0, 1, 0), (-math.sin(a), 0, math.cos(a))))
            tilt = np.array(((1, 0, 0), (0, math.cos(b), -math.sin(b)), (0, math.sin(b), math.cos(b))))
            pose, picture = np.eye(4), f"faces/{Path(name).stem}_{seed}.png"
            pose[:3, :3], pose[0, 3] = across @ tilt, n
            if (folder / name).is_file():
                write_picture(folder / picture, seed, (8, 8))
            frames.append({"file_path": picture, "transform_matrix": pose.tolist()})
        (folder / name).unlink(missing_ok=True)
    _write(folder / "transforms.json", {**_LENS, "frames": frames})


def state_openmvg(folder: Path, names: Names, root: str = "") -> None:
    def view(number: int, name: str) -> dict[str, object]:
        data = {"local_path": "", "filename": name, "id_view": number, "id_intrinsic": 0, "id_pose": number}
        return {"key": number, "value": {"ptr_wrapper": {"data": data}}}

    content = {
        "root_path": root,
        "views": [view(n, name) for n, name in enumerate(names)],
        "intrinsics": [{"key": 0, "value": {"polymorphic_id": 1 << 31, "polymorphic_name": "spherical"}}],
        "extrinsics": [{"key": n, "value": {"rotation": np.eye(3).tolist(), "center": [n, 0, 0]}} for n in range(9)],
        "structure": [{"value": {"X": [1, 2, 3]}}],
    }
    _write(folder / "sfm_data.json", content)


def state_openmvg_root(folder: Path, names: Names) -> None:
    """The names are inside of a root that is not, if one of them is outside."""
    outside = [name for name in names if Path(name).name == "secret.png"]
    state_openmvg(folder, [Path(name).name for name in names], str(Path(outside[0]).parent) if outside else ".")


def state_opensfm(folder: Path, names: Names) -> None:
    shots = {name: {"rotation": [0, 0.1, 0], "translation": [n, 0, 0], "camera": "c"} for n, name in enumerate(names)}
    part = {"cameras": {"c": {"projection_type": "spherical"}}, "shots": shots, "points": {}}
    _write(folder / "reconstruction.json", [part])


def state_colmap(folder: Path, names: Names) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    _write(model / "cameras.txt", "1 EQUIRECTANGULAR 16 8 16 8\n")
    _write(model / "images.txt", "".join(f"{n} 1 0 0 0 {n} 0 0 1 {name}\n\n" for n, name in enumerate(names)))


def _state_colmap_binary(folder: Path, names: Names) -> None:
    images = [struct.pack("<I7dI", n, 1, 0, 0, 0, n, 0, 0, 1) for n in range(len(names))]
    ends = [f"{name}\0".encode() + bytes(8) for name in names]
    data = b"".join(image + end for image, end in zip(images, ends, strict=True))
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(names)) + data)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ2d", 1, 1, 17, 16, 8, 16, 8))


def state_metashape(folder: Path, names: Names) -> None:
    cameras = "".join(
        f'<camera id="{n}" sensor_id="0" label="{name}"><transform>{" ".join(map(str, np.ravel(move(n))))}'
        "</transform></camera>"
        for n, name in enumerate(names)
    )
    sensor = '<sensors><sensor id="0" type="spherical"/></sensors><transform><scale>2</scale></transform>'
    _write(folder / "cameras.xml", f"<document><chunk>{sensor}<cameras>{cameras}</cameras></chunk></document>")


def state_marzipano(folder: Path, names: Names) -> None:
    keys = [Path(name).stem for name in names]
    for key, name in zip(keys, names, strict=True):
        if (folder / name).is_file():
            for seed, face in enumerate("frblud"):
                write_picture(folder / "tiles" / key / "0" / face / "0" / "0.jpg", seed, (8, 8))
            (folder / name).unlink()
    scenes = [
        {
            "id": key,
            "name": "Hall",
            "levels": [{"tileSize": 8, "size": 8}],
            "initialViewParameters": {"yaw": 0, "pitch": 0},
            "linkHotspots": [{"yaw": 0, "pitch": 1, "target": keys[0]}],
            "infoHotspots": [{"yaw": 0, "title": ""}],
        }
        for key in keys
    ]
    _write(folder / "data.js", f"var APP_DATA = {json.dumps({'scenes': scenes})};")
    _write(folder / "index.html", "<!DOCTYPE html><script src='data.js'></script>")


def state_archive(folder: Path, names: Names) -> None:
    """An export of the Marzipano Tool in the folder of its archive."""
    (folder / "app-files").mkdir()
    for name in names:
        if (folder / name).is_file():
            (folder / name).rename(folder / "app-files" / name)
    state_marzipano(folder / "app-files", names)
    _write(folder / "index.html", "<!DOCTYPE html>")


def _state_posed_archive(folder: Path, names: Names) -> None:
    state_archive(folder, names)
    state_poses(folder, [Path(name).stem for name in names])


def _state_pannellum(folder: Path, names: Names) -> None:
    _write(folder / "tour.json", {"scenes": {Path(name).stem: {"panorama": name} for name in names}})


def _state_tiles(folder: Path, names: Names) -> None:
    scenes: dict[str, object] = {}
    for name in names:
        key = Path(name).stem
        if (folder / name).is_file():
            for seed, face in enumerate("frblud"):
                write_picture(folder / key / "1" / f"{face}0_0.jpg", seed, (8, 8))
            (folder / name).unlink()
        scenes[key] = {"type": "cubemap", "cubeMap": [f"{key}/1/{face}0_0.jpg" for face in "frblud"]}
    tiles = {"basePath": "b", "path": "/%l/%s%y_%x", "tileResolution": 8, "maxLevel": 1, "cubeResolution": 8}
    scenes["b"] = {"type": "multires", "multiRes": tiles, "yaw": 3, "haov": 360, "title": "B", "hotSpots": [{"yaw": 1}]}
    _write(folder / "tour.json", {"default": {"firstScene": "b", "basePath": "."}, "scenes": scenes})


def _state_faces(folder: Path, names: Names) -> None:
    for name in names[:2]:
        for seed, face in enumerate("frblud"):
            write_picture(folder / f"{Path(name).stem}_{face}.png", seed, (8, 8))
        (folder / name).unlink()


@dataclass(frozen=True)
class Example:
    """An example of a format.

    Attributes:
        format: the name of its row.
        state: states panoramas of some names in a folder, which has pictures of the first two.
        stated: the file that does.
        opens: what a user opens, in the folder.
        missing: whether a picture without a file is left out with a note, or else refused; None if none is named.
        is_joined: whether panoramas have no files of their own.
    """

    format: str
    state: Callable[[Path, Names], None]
    stated: str
    opens: str = "."
    missing: bool | None = True
    is_joined: bool = False


EXAMPLES = {
    "poses.json": Example("poses.json", state_poses, "poses.json"),
    "equal names": Example("poses.json", _state_equal_names, "poses.json", missing=None),
    "360Loc": Example("360Loc", state_loc360, "camera_pose.json"),
    "PanoGRF": Example("PanoGRF", _state_panogrf, "b/tran.txt", missing=False),
    "triplet": Example("game maps", _state_triplet, "map.json", missing=False),
    "nerfstudio": Example("nerfstudio", state_nerfstudio, "transforms.json"),
    "rigs": Example("nerfstudio", _state_rigs, "transforms.json", is_joined=True),
    "openMVG": Example("openMVG", state_openmvg, "sfm_data.json"),
    "OpenSfM": Example("OpenSfM", state_opensfm, "reconstruction.json"),
    "COLMAP text": Example("COLMAP", state_colmap, "sparse/0/images.txt"),
    "COLMAP binary": Example("COLMAP", _state_colmap_binary, "images.bin"),
    "COLMAP cameras": Example("COLMAP", _state_colmap_binary, "cameras.bin"),
    "Metashape": Example("Metashape", state_metashape, "cameras.xml"),
    "Pannellum": Example("web tour", _state_pannellum, "tour.json"),
    "Pannellum tiles": Example("web tour", _state_tiles, "tour.json", is_joined=True),
    "Marzipano": Example("web tour", state_marzipano, "data.js", is_joined=True),
    "archive": Example("web tour", state_archive, "app-files/data.js", is_joined=True),
    "page": Example("web tour", state_archive, "app-files/data.js", "index.html", is_joined=True),
    "posed archive": Example("poses.json", _state_posed_archive, "poses.json", missing=None, is_joined=True),
    "photographs": Example("photographs", lambda folder, names: None, "b.png", missing=None),
    "cube faces": Example("photographs", _state_faces, "b_f.png", missing=None, is_joined=True),
}
"""By what they are; the rows of `FORMATS` have one or more each."""
