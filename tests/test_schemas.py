"""Any part of a valid file, and any number of any command, may be anything: it is read, or the message names it."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import random
import re
import struct
import typing
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat.cli import _COMMANDS
from pansplat.cli.batch import list_items
from pansplat.errors import InputError, collect_notes
from pansplat.gaussians.formats import load_scene
from pansplat.gaussians.gltf import save_glb
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.gaussians.scene_files import format_entry, make_scene
from pansplat.inputs.folders import load_pairs
from pansplat.model.network import build_empty_network
from pansplat.model.weights import WeightsFile
from pansplat.system.options import check_numbers
from pansplat.tours.camera_path import read_path
from pansplat.training.checkpoint import extract_weights, load_checkpoint
from pansplat.training.config import TrainConfig
from pansplat_viewer.app import Options

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 7, 0.5, 1e300, 10**400, math.nan, "", "x", "../x", [], {}, [[1, 2], [3]], {"a": 1}, [None],
)  # fmt: skip
NUMBERS = (-1, 0, 0.5, 1, 64.0, 10**9, 10**30, 1e300, math.nan, math.inf, True)
EYE = np.eye(4).tolist()
LABELS = torch.tensor([0] * 6 + [1] * 6)
SCENE = Scene(
    Gaussians(*(torch.ones(12, *shape) for shape in ((3,), (3,), (4,), (), (1, 3))), torch.zeros_like(LABELS), LABELS),
    torch.eye(4, dtype=torch.float64).repeat(2, 1, 1),
    near=0.45,
    far=10.0,
    names=("a", "b"),
    model="sweep",
    height=64,
    gains=((1.0, 1.0, 1.0), (1.0, 0.9, 1.0)),
    overlaps=((0, 1, 0.5),),
    links=((0, 1, 0.1, 0.2, "door"),),
    starts=((0.1, 0.2), None),
)

Case = tuple[Any, Callable[[Any], object]]
"""The content of a file, and a function that writes and reads another content."""


def json_case(path: Path, content: Any, read: Callable[[Path], object]) -> Case:
    def write_and_read(changed: Any) -> object:
        path.write_text(json.dumps(changed))
        return read(path)

    return content, write_and_read


def folder_case(folder: Path, name: str, content: Any, **others: Any) -> Case:
    """A folder of panoramas with a file that states their poses, pairs or links."""
    for image in ("a.png", "b.png"):
        Image.fromarray(np.full((8, 16, 3), 99, np.uint8)).save(folder / image)
    for other, text in others.items():
        (folder / f"{other}.json").write_text(json.dumps(text))
    return json_case(folder / name, content, lambda path: load_pairs(path.parent))


def glb_case(folder: Path) -> Case:
    save_glb(SCENE, folder / "scene.glb")
    data = (folder / "scene.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    content = json.loads(data[20 : 20 + length])
    del content["asset"]

    def write_and_read(changed: Any) -> object:
        text = json.dumps(changed).encode()
        head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(data) - 20 - length, len(text), 0x4E4F534A)
        (folder / "scene.glb").write_bytes(head + text + data[20 + length :])
        return load_scene(folder / "scene.glb")

    return content, write_and_read


def checkpoint_case(folder: Path) -> Case:
    weights = {"model": "pansplat", "config": {"a": 1}, "compat": "fixed"}
    content = {"step": 3, "weights": weights, "network": {"a": 1}, "mean": None, "auxiliary": None, "optimizer": {}}

    def write_and_read(changed: Any) -> object:
        changed = dict(changed, weights=json.dumps(changed["weights"])) if "weights" in changed else changed
        network = changed.get("network")
        if isinstance(network, dict) and network.get("a") == 1:
            changed["network"] = {"a": torch.ones(2)}
        torch.save({"kind": "pansplat-training", "format": 1, **changed}, folder / "step.pt")
        return extract_weights(load_checkpoint(folder / "step.pt"), folder / "step.pt")

    return content, write_and_read


_POSES = {"convention": "cam2world opencv", "poses": {"a.png": EYE, "b.png": EYE}}
_LENS = {"polymorphic_id": 1 << 31, "polymorphic_name": "spherical", "ptr_wrapper": {"data": {}}}
_VIEWS = [{"filename": name, "id_intrinsic": 0, "id_pose": 0} for name in ("a.png", "b.png")]
_SHOT = {"rotation": [0, 0.1, 0], "translation": [1, 0, 0], "camera": "c"}
_FRAME = {"file_path": "a.png", "transform_matrix": EYE}
_MVG = {
    "views": [{"value": {"ptr_wrapper": {"data": view}}} for view in _VIEWS],
    "intrinsics": [{"key": 0, "value": _LENS}],
    "extrinsics": [{"key": 0, "value": {"rotation": np.eye(3).tolist(), "center": [0, 0, 1]}}],
    "structure": [{"value": {"X": [1, 2, 3]}}],
}
_KEY_FRAME = {"seconds": 1, "position": [0, 0, 0], "direction": [0, 0, 1], "vertical_fov_degrees": 75}
_CASES: dict[str, Callable[[Path], Case]] = {
    "poses": lambda f: folder_case(
        f, "poses.json", _POSES | {"near": 0.5, "far": 9, "worlds": [{"near": 1, "far": 2}, {}]}
    ),
    "worlds": lambda f: folder_case(
        f, "poses.json", _POSES | {"poses": {"a.png": EYE, "b.png": {"cam2world": EYE, "world": 1, "room": "hall"}}}
    ),
    "pairs": lambda f: folder_case(
        f, "pairs.json", {"pairs": [{"context": ["a.png", "b.png"], "target": "b.png"}], "triplets": []}, poses=_POSES
    ),
    "nerfstudio": lambda f: folder_case(
        f, "transforms.json", {"camera_model": "EQUIRECTANGULAR", "applied_scale": 2, "frames": [_FRAME]}
    ),
    "openMVG": lambda f: folder_case(f, "sfm_data.json", _MVG),
    "OpenSfM": lambda f: folder_case(
        f,
        "reconstruction.json",
        [{"cameras": {"c": {"projection_type": "spherical"}}, "shots": {"a.png": _SHOT, "b.png": dict(_SHOT)}}],
    ),
    "manifest": lambda f: json_case(
        f / "all.json", {"items": ["b", "a"]}, list_items
    ),
    "key frames": lambda f: json_case(f / "path.json", {"key_frames": [_KEY_FRAME], "software": "x"}, read_path),
    "glTF": glb_case,
    "checkpoint": checkpoint_case,
}  # fmt: skip


def list_parts(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of each value in nested lists and objects."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from list_parts(value, (*path, key))


def change(content: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at a path."""
    copied = copy.deepcopy(content)
    holder = copied
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return copied


def list_changes(content: Any, seed: str) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Some other values of each part: its path, and the changed content."""
    rng = random.Random(seed)
    for path in list_parts(content):
        for value in rng.sample(VALUES, 5):
            yield path, change(content, path, value)


_WHOLE = "no Gaussians|one length|accessor|another file|spherical|another content|its pictures|frame .:|png'"
_WHOLE += "|its . cameras|must be|settings of a"
"""Of messages about values that contradict each other or leave nothing, or about a picture or accessor."""


def require_named(path: tuple[Any, ...], message: str) -> None:
    names = [part.replace("_", " ") if isinstance(part, str) else f"[{part}]" for part in path]
    assert any(name in message.replace("_", " ") for name in names) or re.search(_WHOLE, message), (path, message)


@pytest.mark.parametrize("name", _CASES)
def test_a_file_with_any_other_value_is_read_or_the_message_names_it(name: str, tmp_path: Path) -> None:
    content, write_and_read = _CASES[name](tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_and_read(content)
        refused = 0
        for path, changed in list_changes(content, name):
            try:
                write_and_read(changed)
            except InputError as error:
                refused += 1
                require_named(path, str(error))
    assert refused > 5


def test_a_scene_with_any_other_value_in_its_comment_keeps_its_gaussians_and_a_note_names_it() -> None:
    content = json.loads(format_entry(SCENE, [[0, 0, 6], [0, 1, 6]]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for path, changed in list_changes(content, "comment"):
            with collect_notes() as notes:
                scene = make_scene(SCENE.gaussians, json.dumps(changed), Path("scene.ply"))
            assert len(scene.gaussians) == 12 and scene.gaussians.views.max() < max(len(scene.cam2world), 1)
            for note in notes:
                require_named(path, note.replace("levels and views", "runs"))


def test_a_network_with_any_other_setting_is_built_or_the_message_names_it(small_config: Any) -> None:
    content = json.loads(json.dumps(dataclasses.asdict(small_config)))
    for path, changed in list_changes(content, "network"):
        try:
            build_empty_network(WeightsFile("pansplat", changed, "fixed", {}), "fixed", "weights")
        except InputError as error:
            require_named(path, str(error))


COMMANDS = [getattr(import_module(f"pansplat.cli.{name}"), name.title()) for name in _COMMANDS]


def list_kinds(hint: Any) -> list[type]:
    """The dataclasses in an annotation."""
    inner = [kind for part in typing.get_args(hint) for kind in list_kinds(part)]
    return [hint] if isinstance(hint, type) and dataclasses.is_dataclass(hint) else inner


def make_default(kind: type) -> Any:
    """An instance of a command with its default values; options that are needed are None."""
    options, hints = object.__new__(kind), typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        kinds, default = list_kinds(hints[field.name]), field.default_factory
        value = None if field.default is dataclasses.MISSING else field.default
        value = value if default is dataclasses.MISSING else default()
        object.__setattr__(options, field.name, make_default(kinds[0]) if kinds else value)
    return options


def list_numbers(options: Any, prefix: str, prefixed: bool) -> Iterator[tuple[Any, str, str, Any]]:
    """The options that are numbers: their dataclass, field, name and type."""
    for name, hint in typing.get_type_hints(type(options), include_extras=True).items():
        named = [mark.name for mark in getattr(hint, "__metadata__", ()) if getattr(mark, "name", None)]
        option, value = prefix + [name, *named][-1].replace("_", "-"), getattr(options, name)
        if dataclasses.is_dataclass(value):
            yield from list_numbers(value, f"{option}." if prefixed else prefix, prefixed)
        elif "Meta(" in str(hint):
            yield options, name, option, hint
        else:
            assert hint not in (int, float, int | None, float | None), option  # each number has a range


def fill(hint: Any, value: Any) -> Any:
    """A value of an option; of several numbers all are the same."""
    kinds = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        return (value,) * (1 if ... in kinds else len(kinds))
    return fill(kinds[0], value) if type(None) in kinds else value


SUITES = list_kinds(typing.get_type_hints(COMMANDS[_COMMANDS.index("bench")], include_extras=True)["what"])


@pytest.mark.parametrize("kind", [*COMMANDS, *SUITES, TrainConfig, Options], ids=lambda kind: kind.__name__)
def test_a_number_of_a_command_is_in_its_range_or_the_message_names_the_option(kind: type) -> None:
    options = make_default(kind)
    for holder, name, option, hint in list(list_numbers(options, "--", kind is TrainConfig)):
        default = getattr(holder, name)
        for value in NUMBERS:
            object.__setattr__(holder, name, fill(hint, value))
            is_number = not isinstance(value, bool) and not math.isnan(value)
            try:
                check_numbers(options, prefixed=kind is TrainConfig)
                assert is_number and (abs(value) < 1e13 or option in ("--optimizer.clip", "--checkpoint.minutes"))
            except InputError as error:
                assert str(error).startswith(option)
        object.__setattr__(holder, name, default)
