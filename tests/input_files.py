"""The files that pansplat reads: an undamaged one of each kind with its reader, for the properties that all have."""

from __future__ import annotations

import dataclasses
import json
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import safetensors.torch
import torch
from panorama_formats import EXAMPLES, Example, write_picture, write_room
from PIL import Image

from pansplat.cli.render import read_pose
from pansplat.errors import InputError, collect_notes
from pansplat.gaussians.formats import load_scene, save_scene
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.gaussians.scene_files import format_entry, restore_scene
from pansplat.images.cube_images import CubeImage, CubeLevel, write_cube
from pansplat.images.image_files import read_depth, read_height, read_panorama, write_image
from pansplat.inputs.folders import load_panoramas, load_sets
from pansplat.inputs.formats import FORMATS
from pansplat.model.network import build_empty_network
from pansplat.model.pansplat import PanSplatConfig
from pansplat.networks.weights import WeightsFile, load_weights, read_checkpoint
from pansplat.pipeline import render
from pansplat.system.files import SCENE_SUFFIXES
from pansplat.system.strict_json import read_json
from pansplat.tours.camera_path import read_path
from pansplat.training.checkpoint import load_checkpoint

EYE = np.eye(4).tolist()
IN_PART = "read in part: "
"""The start of notes about what a folder of panoramas left out."""
_NAMES = ("a.png", "b.png")
_CHECKED = 29  # bytes of checksums and end marks behind the pixels of a picture
_LABELS = torch.tensor([0] * 6 + [1] * 6)
SCENE = Scene(
    Gaussians(
        *(torch.ones(12, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))), torch.zeros_like(_LABELS), _LABELS
    ),
    torch.eye(4, dtype=torch.float64).repeat(2, 1, 1),
    near=0.45,
    far=10.0,
    names=("a", "b"),
    model="sweep",
    height=64,
    gains=((1.0, 1.0, 1.0), (1.0, 0.9, 1.0)),
    starts=((0.1, 0.2), None),
    tour=SceneTour(((0, 1, 0.5),), ((0, 1, 0.1, 0.2, "door"),)),
)


@dataclass(frozen=True)
class InputFile:
    """A file and its reader.

    Attributes:
        path: the file.
        read: its reader, which returns notes about what it left out; it raises InputError.
        document: the JSON document in the file, or None.
        pack: the content of a file with another document.
        is_recognised: whether the file is still read as one of its kind, which its content may decide.
        has_cuts: whether a file that is cut may be a valid one.
        idle: bytes at the end of the file that say nothing.
        companion: another file of the same model, which messages may name.
    """

    path: Path
    read: Callable[[Path], str]
    document: Any = None
    pack: Callable[[Any], bytes] = lambda document: json.dumps(document).encode()
    is_recognised: Callable[[], bool] = lambda: True
    has_cuts: bool = False
    idle: int = 0
    companion: str = ""


def _whole(read: Callable[[Path], object]) -> Callable[[Path], str]:
    """A reader without notes."""

    def read_whole(path: Path) -> str:
        read(path)
        return ""

    return read_whole


def _make_json(path: Path, document: Any, read: Callable[[Path], object]) -> InputFile:
    path.write_text(json.dumps(document))
    return InputFile(path, _whole(read), document)


def _make_room(folder: Path, example: Example) -> InputFile:
    """A file that states two panoramas; the reader is that of their folder."""
    example.state(write_room(folder, _NAMES), _NAMES)
    file, document, pack = folder / example.stated, None, InputFile.pack
    if file.suffix in (".json", ".js"):
        found = re.fullmatch(r"([^\[{]*)(.*[\]}])(.*)", file.read_text(), re.DOTALL)
        assert found is not None
        head, text, tail = found.groups()
        document, pack = json.loads(text), lambda changed: (head + json.dumps(changed) + tail).encode()

    def read(path: Path) -> str:
        with collect_notes() as notes:
            try:
                panoramas = load_panoramas(folder / example.opens)
            except InputError as error:
                raise InputError("\n".join([*notes, str(error)])) from error
        names = {view.name for view in panoramas}
        assert all(view.image.is_file() for view in panoramas)
        assert all(link.target in names for view in panoramas for link in view.links)
        text = "\n".join(note for note in notes if "scale.txt" not in note)  # of an arbitrary unit
        if not panoramas:
            raise InputError(text)
        return f"{IN_PART}{text}" if len(panoramas) < len(_NAMES) or path.name in text else ""

    def is_recognised() -> bool:
        return next(form for form in FORMATS if form.find(folder)).name == example.format

    companion = "images.bin" if file.name == "cameras.bin" else ""
    return InputFile(file, read, document, pack, is_recognised, has_cuts=True, companion=companion)


def _make_pair(folder: Path, name: str, document: Any, **others: Any) -> InputFile:
    """A file of a folder of panoramas that states their poses or pairs."""
    write_room(folder, _NAMES)
    for other, content in others.items():
        (folder / f"{other}.json").write_text(json.dumps(content))
    return _make_json(folder / name, document, lambda path: load_sets(folder))


def _make_scene(folder: Path, suffix: str) -> InputFile:
    path = folder / f"scene{suffix}"
    save_scene(SCENE, path)

    def read(path: Path) -> str:
        drawn = render(load_scene(path), torch.eye(4, dtype=torch.float64), size=(8, 16), blend="joint")
        assert drawn.color.isfinite().all() and drawn.depth.isfinite().all()
        return ""

    if suffix == ".splat":  # without a header: each 32 bytes are a Gaussian
        return InputFile(path, read, is_recognised=lambda: path.stat().st_size % 32 > 0, has_cuts=True)
    if suffix != ".glb":
        return InputFile(path, read)
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    del document["asset"]

    def pack(document: Any) -> bytes:
        text = json.dumps(document).encode()
        return struct.pack("<4sIIII", b"glTF", 2, len(data) - length + len(text), len(text), 0x4E4F534A) + (
            text + data[20 + length :]
        )

    return InputFile(path, read, document, pack)


def _make_comment(folder: Path) -> InputFile:
    """The entry of pansplat in a scene file; whatever it is, the Gaussians are read."""
    path = folder / "comment.json"
    document = json.loads(format_entry(SCENE, [[0, 0, 6], [0, 1, 6]]))
    path.write_text(json.dumps(document))

    def read(path: Path) -> str:
        with collect_notes() as notes:
            scene = restore_scene(SCENE.gaussians, path.read_text(errors="replace"), path)
        assert len(scene.gaussians) == 12 and scene.gaussians.views.max() < max(len(scene.cam2world), 1)
        return "\n".join(notes).replace("levels and views", "runs")

    return InputFile(path, read, document, is_recognised=lambda: False, has_cuts=True)


def _make_checkpoint(folder: Path) -> InputFile:
    """A training checkpoint; where its document has the network {"a": 1}, the file has a tensor of two ones."""
    path = folder / "training.pt"
    document = {"step": 3, "network": {"a": 1}, "mean": None, "auxiliary": None, "optimizer": {}}

    def pack(document: Any) -> bytes:
        if not isinstance(document, dict):
            torch.save(document, path)
            return path.read_bytes()
        changed = dict(document)
        if isinstance(network := changed.get("network"), dict) and network.get("a") == 1:
            changed["network"] = {"a": torch.ones(2)}
        torch.save({"kind": "pansplat-training", "format": 1, **changed}, path)
        return path.read_bytes()

    pack(document)
    return InputFile(path, _whole(load_checkpoint), document, pack)


def _make_network(folder: Path) -> InputFile:
    """The settings of a network."""

    def read(path: Path) -> object:
        return build_empty_network(
            WeightsFile("pansplat", read_json(path, dict[str, Any]), "fixed", {}), "fixed", path.name
        )

    return _make_json(folder / "network.json", json.loads(json.dumps(dataclasses.asdict(PanSplatConfig()))), read)


def _make_weights(folder: Path) -> InputFile:
    metadata = {"pansplat_format": "1", "model": "pansplat", "config": '{"a": [1, 2]}', "compat": "fixed"}
    tensors = {"a": torch.zeros(3), "b": torch.zeros(2, 2, dtype=torch.float16)}
    safetensors.torch.save_file(tensors, folder / "small.safetensors", metadata)
    return InputFile(folder / "small.safetensors", _whole(load_weights))


def _make_official(folder: Path) -> InputFile:
    torch.save({"state_dict": {"encoder.a": torch.zeros(3)}}, folder / "official.ckpt")
    return InputFile(folder / "official.ckpt", _whole(read_checkpoint))


def _make_image(folder: Path, suffix: str) -> InputFile:
    if suffix == ".exr":
        write_image(folder / "image.exr", np.random.default_rng(0).integers(0, 255, (8, 16, 3), np.uint8))
    else:
        write_picture(folder / f"image{suffix}")
    return InputFile(folder / f"image{suffix}", _whole(lambda path: read_panorama(path, 4)), idle=_CHECKED)


def _make_depth(folder: Path) -> InputFile:
    cv2.imwrite(str(folder / "depth.png"), np.full((8, 16), 999, np.uint16))
    return InputFile(folder / "depth.png", _whole(lambda path: read_depth(path, 4)), idle=_CHECKED)


def _make_cube(folder: Path) -> InputFile:
    """The description of a panorama of cube faces."""
    for face in "frblud":
        Image.new("RGB", (8, 8)).save(folder / f"{face}.png")
    path = write_cube(CubeImage(folder, (CubeLevel(8, 8, tuple(f"{face}.png" for face in "frblud")),)), folder, "x")
    return _make_json(path, json.loads(path.read_text()), read_height)


_POSES = {"convention": "cam2world opencv", "poses": {"a.png": EYE, "b.png": EYE}}
_WORLDS = {"near": 0.5, "far": 9, "worlds": [{"near": 1, "far": 2}, {}]}
_OTHER_WORLD = {"a.png": EYE, "b.png": {"cam2world": EYE, "world": 1, "room": "hall"}}
_PAIRS = {"pairs": [{"context": [*_NAMES], "target": "b.png"}], "triplets": []}
_KEY_FRAME = {"seconds": 1, "position": [0, 0, 0], "direction": [0, 0, 1], "vertical_fov_degrees": 75}

FILES: dict[str, Callable[[Path], InputFile]] = {
    **{
        f"room, {name}": lambda folder, example=example: _make_room(folder, example)
        for name, example in EXAMPLES.items()
        if example.format != "photographs"
    },
    "worlds": lambda folder: _make_pair(folder, "poses.json", _POSES | _WORLDS),
    "poses of two worlds": lambda folder: _make_pair(folder, "poses.json", _POSES | {"poses": _OTHER_WORLD}),
    "pairs": lambda folder: _make_pair(folder, "pairs.json", _PAIRS, poses=_POSES),
    "key frames": lambda folder: _make_json(
        folder / "path.json", {"key_frames": [_KEY_FRAME], "software": "x"}, read_path
    ),
    "pose": lambda folder: _make_json(folder / "pose.json", EYE, read_pose),
    **{f"scene{suffix}": lambda folder, suffix=suffix: _make_scene(folder, suffix) for suffix in SCENE_SUFFIXES},
    "scene comment": _make_comment,
    "network": _make_network,
    "weights": _make_weights,
    "training checkpoint": _make_checkpoint,
    "official checkpoint": _make_official,
    **{
        f"image{suffix}": lambda folder, suffix=suffix: _make_image(folder, suffix)
        for suffix in (".png", ".jpg", ".webp", ".tif", ".exr")
    },
    "depth": _make_depth,
    "cube": _make_cube,
}

DOCUMENTS = [
    *(f"room, {name}" for name, example in EXAMPLES.items() if example.stated.endswith((".json", ".js"))),
    *("worlds", "poses of two worlds", "pairs", "key frames", "pose", "scene.glb", "scene comment"),
    *("network", "training checkpoint", "cube"),
]
"""The names of those with a JSON document."""
