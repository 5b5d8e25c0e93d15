# ruff: noqa: E501  # a fault is one line
"""The table of faults: each is one line that names the file or the option, a status, and no half-written file."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
from PIL import Image

Damage = Callable[[Path], object]
_DEEP = "[" * 100_000
_LONG = "a" * 300
_HUGE = 10**400


def edit_comment(path: Path, change: Callable[[dict[str, Any]], Any] | str) -> None:
    """Change the pansplat comment of a scene; a text replaces its JSON."""
    head, rest = path.read_bytes().split(b"comment pansplat ", 1)
    comment, rest = rest.split(b"\n", 1)
    if callable(change):
        content = json.loads(comment)
        change(content)
        change = json.dumps(content)
    path.write_bytes(head + b"comment pansplat " + change.encode("utf-8", "surrogatepass") + b"\n" + rest)


def replace_bytes(path: Path, old: bytes, new: bytes) -> None:
    """Replace the first occurrence."""
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


def nothing(folder: Path) -> None:
    """Leave the files as they are."""


@dataclass(frozen=True)
class Fault:
    """A fault: how the files are damaged, the command, and how it must end; without `says`, with notes only."""

    name: str
    command: str
    damage: Damage = nothing
    says: str = ""
    status: int = 2


INFO = "info scene.ply"
DRAW = "render scene.ply -o x.png --height 8"
PREDICT = "predict pair -o out.ply --model sphere --height 64 --refine 0"
WEIGHTS = "predict pair -o out.ply --model weights.safetensors --height 64"


# Group 1: scene files


def comment(change: Callable[[dict[str, Any]], Any] | str) -> Damage:
    return lambda folder: edit_comment(folder / "scene.ply", change)


def header(old: bytes, new: bytes) -> Damage:
    return lambda folder: replace_bytes(folder / "scene.ply", old, new)


def content(data: bytes | Callable[[bytes], bytes], name: str = "scene.ply") -> Damage:
    def write(folder: Path) -> None:
        path = folder / name
        path.write_bytes(data if isinstance(data, bytes) else data(path.read_bytes()))

    return write


def vertices(value: float) -> Damage:
    """All numbers of all vertices have a value."""

    def write(folder: Path) -> None:
        head, body = (folder / "scene.ply").read_bytes().split(b"end_header\n")
        values = np.full(len(body) // 4, value, "<f4").tobytes()
        (folder / "scene.ply").write_bytes(head + b"end_header\n" + values)

    return write


SCENES = [
    Fault("runs: sum that overflows, drawn", DRAW, comment(lambda c: c.update(runs=[[0, 0, 10**18 - 1]] * 19 + [[0, 0, 12]])), "are ignored", 0),
    Fault("comment: a near that is a text", INFO, comment(lambda c: c.update(near="0.45")), "comment is damaged", 0),
    Fault("comment: nested 100,000 deep", INFO, comment(_DEEP), "comment is damaged", 0),
    Fault("header: 10^18 vertices", INFO, header(b"vertex 12", b"vertex 1" + b"0" * 18), "truncated"),
    Fault("header: 5000 digits of vertices", INFO, header(b"vertex 12", b"vertex 1" + b"0" * 5000), "header line"),
    Fault("header: vertices without properties", INFO, header(b"property float x\n", b"element face 10000000000000\nproperty float x\n"), "vertices lack"),
    Fault("header: a huge element before the vertices", INFO, header(b"element vertex", b"element face 99999999999999999999\nproperty int a\nelement vertex"), "truncated"),
    Fault("header: a property without a name", INFO, header(b"property float x\n", b"property\n"), "header line"),
    Fault("header: 5000 properties", INFO, header(b"property float x\n", b"".join(b"property float p%d\n" % i for i in range(5000))), "header line"),
    Fault("file: a picture", INFO, lambda folder: (folder / "scene.ply").write_bytes((folder / "pair/a.png").read_bytes()), "not a .ply"),
    Fault("file: cut in the vertices", INFO, content(lambda data: data[:-5]), "truncated"),
    Fault("file: cut in the header, viewed", "pansplat-view scene.ply --offscreen out", content(lambda data: data[:100]), "scene.ply"),
    Fault("vertices: -3e38, as a page", "export scene.ply -o tour.html", vertices(-3e38), "no visible Gaussians"),
    Fault("a page over a file named like its folder", "export scene.ply -o tour", lambda folder: ((folder / "tour").mkdir(), (folder / "tour/index_files").write_text("")), "index_files"),
    Fault("vertices: -3e38, drawn", DRAW, vertices(-3e38), "", 0),
]  # fmt: skip


# Group 2: numbers on command lines


TRAIN = "pansplat-train tiny --out run --device cpu"

SIZES = [
    *(Fault(f"{command[:16]} {option} {value}", f"{command} {option} {value}", says=option) for command, option, value in (
        ("predict pair -o out.ply", "--height", "63"), ("predict pair -o out.ply", "--height", "abc"), ("predict pair -o out.ply", "--height", "9" * 5000),
        (TRAIN, "--optimizer.batch-size", "0"), (TRAIN, "--optimizer.ema", "2"), ("pansplat-view scene.ply", "--fps", "nan"))),
    *(Fault(f"pose --baseline a.png b.png {distance}", f"pose pair --baseline a.png b.png {distance}", says="`baseline` must be") for distance in ("0", "nan")),
    Fault("pose --baseline of one panorama", "pose pair --baseline a.png a.png 1", says="`baseline` must be"),
    Fault("pose --baseline of a missing panorama", "pose pair --baseline a.png x.png 1", says="x.png"),
    Fault("pose --baseline without a distance", "pose pair --baseline a.png b.png", says="--baseline"),
    Fault("export --gaussians 5000000", "export scene.ply -o tour.html --gaussians 5000000", says="4,000,000 in a page"),
    Fault("render --stereo of a perspective image", "render scene.ply --stereo --layout perspective -o x.png", says="--stereo is for"),
    *(Fault(f"view {options}", f"pansplat-view scene.ply {options}", says=says) for options, says in (
        ("--size 4x4", "WIDTHxHEIGHT"), ("--size huge", "WIDTHxHEIGHT"), ("--at 1.5", "--at: needed a number <= 1"), ("--pair kitchen", "number from 1 to 1 or one of scene"),
        ("--path no.json", "no.json"), ("--refine -1", "--refine: needed a whole number >= 0"))),
    Fault("view: a scene that is missing", "pansplat-view nowhere", says="no such file or folder"),
    *(Fault(f"train {options}", f"pansplat-train {options} --device cpu --data.workers 0 --perceptual structure", says=says) for options, says in (
        ("tiny --out run --data.kind triplets", "--data.kind triplets needs --data.root"), ("small", "needs --data.root"),
        ("tiny --optimizer.steps 0", "--optimizer.steps: needed a whole number >= 1, got 0"), ("pansplat-256 --data.root nowhere", "--network.init"), ("tiny --network.init none.safetensors", "none.safetensors"),
        ("", "tiny"), ("gigantic", "gigantic"), ("tiny --optimizer.stepps 3", "--optimizer.steps"), ("tiny --memory.backpropagation three-step", "two-step"))),
    *(Fault(f"bench {options}", f"bench {options}", says=says) for options, says in (
        ("raster --height 20", "multiple of 8"), ("raster --height 7", "--height: needed"), ("raster --threads 0", "--threads: needed a whole number >= 1"), ("raster --json rows.json", "--json"),
        ("raster none.ply", "none.ply"), ("model --height 80", "multiple of 64"), ("model --pair nowhere", "nowhere is not a folder"), ("model --height 64 --model none.safetensors", "none.safetensors"),
        ("viewer --heights 20", "multiple of 8"), ("viewer --size 8 8", "--size, [0]: needed a whole number >= 64"))),
    Fault("an option without its number", "predict pair -o out.ply --height", says="--height"),
    Fault("an option that is missing", "predict pair", says="--out"),
    Fault("a misspelt option", "predict pair -o out.ply --heigth 64", says="--height"),
    Fault("a choice that is missing", "render scene.ply -o x.png --layout fisheye", says="--layout"),
    Fault("a number of a view with 400 digits", f"render scene.ply -o x.png --blend view{_HUGE}", says="--blend"),
    Fault("a number of a pair with 400 digits", f"{PREDICT} --pair {_HUGE}", says="--pair"),
    *(Fault(f"predict --height {height} works", f"predict pair -o out.ply --model sphere --refine 0 --height {height}", status=0) for height in (64, 65)),
    *(Fault(f"render --height {height} works", f"render scene.ply -o x.png --height {height}", status=0) for height in (2, 11)),
]  # fmt: skip


# Group 3: numbers in files


def text(value: str, name: str = "pair/poses.json") -> Damage:
    return lambda folder: (folder / name).write_text(value)


def pairs(value: Any) -> Damage:
    return text(json.dumps(value), "pair/pairs.json")


def many_panoramas(folder: Path) -> None:
    """A pair of 1,000 context panoramas."""
    content = json.loads((folder / "pair/poses.json").read_text())
    for number in range(1000):
        os.symlink("a.png", folder / "pair" / f"v{number}.png")
        content["poses"][f"v{number}.png"] = [[1, 0, 0, number], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (folder / "pair/poses.json").write_text(json.dumps(content))
    pairs({"pairs": [{"context": [f"v{number}.png" for number in range(1000)]}]})(folder)


NUMBERS = [
    Fault("poses: a name of 300 bytes", PREDICT, text(f'{{"convention": "cam2world opencv", "poses": {{"{_LONG}.png": 1}}}}'), _LONG),
    Fault("pairs: 1,000 context panoramas", PREDICT, many_panoramas, "at most 64"),
]  # fmt: skip


# Group 4: weights and checkpoints


def settings(change: Callable[[dict[str, Any]], Any] | str, **metadata: str) -> Damage:
    """Change the settings in the metadata of the weights."""

    def write(folder: Path) -> None:
        path = folder / "weights.safetensors"
        with safetensors.safe_open(path, "pt") as file:
            entries, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if callable(change):
            config = json.loads(entries["config"])
            change(config)
            entries["config"] = json.dumps(config)
        else:
            entries["config"] = change
        safetensors.torch.save_file(tensors, path, entries | metadata)

    return write


def tensors(change: Callable[[dict[str, torch.Tensor]], Any]) -> Damage:
    """Change the tensors of the weights."""

    def write(folder: Path) -> None:
        path = folder / "weights.safetensors"
        with safetensors.safe_open(path, "pt") as file:
            entries, content = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        safetensors.torch.save_file(change(content) or content, path, entries)

    return write


def cast(dtype: torch.dtype) -> Damage:
    return tensors(lambda state: {n: t.to(dtype) if t.is_floating_point() else t for n, t in state.items()})


def first(change: Callable[[torch.Tensor], torch.Tensor]) -> Damage:
    """Change the first floating-point tensor."""

    def apply(state: dict[str, torch.Tensor]) -> None:
        name = next(name for name, tensor in state.items() if tensor.is_floating_point())
        state[name] = change(state[name])

    return tensors(apply)


def pickled(value: object) -> Damage:
    return lambda folder: torch.save(value, folder / "old.ckpt")


class Calls:
    """Makes a folder when it is unpickled."""

    def __reduce__(self) -> tuple:
        return os.mkdir, ("executed",)


CKPT = "predict pair -o out.ply --model old.ckpt --height 64"
CHECKPOINTS = [
    Fault("settings: a million blocks", WEIGHTS, settings(lambda c: c["features"]["transformer"].update(blocks=10**6)), "blocks"),
    *(Fault(f"settings: {value[:12]}", WEIGHTS, settings(value), "weights.safetensors: config") for value in (_DEEP, "[]", "5", "null", "{", '"a"', "{}")),
    Fault("metadata: an unknown network", WEIGHTS, settings(lambda c: None, model="gan"), "'gan'"),
    Fault("metadata: a depth network with other settings", WEIGHTS, settings(lambda c: None, model="depth"), "config"),
    Fault("bfloat16 works", WEIGHTS, cast(torch.bfloat16), status=0),
    Fault("integers instead of numbers", WEIGHTS, first(lambda t: t.to(torch.int8)), "int8"),
    Fault("complex numbers", WEIGHTS, first(lambda t: t.to(torch.complex64)), "weights.safetensors"),
    Fault("NaN in a tensor", WEIGHTS, first(lambda t: t * float("nan")), "NaN"),
    Fault("weights with a header of 2^60 bytes", WEIGHTS, content(lambda data: (2**60).to_bytes(8, "little") + data[8:], "weights.safetensors"), "weights.safetensors"),
    Fault("weights: a scene", "predict pair -o out.ply --model scene.ply", says="`model`"),
    Fault("checkpoint: foreign tensors", CKPT, pickled({"state_dict": {"a": torch.zeros(1)}}), "official"),
    Fault("checkpoint: code", CKPT, pickled({"state_dict": Calls()}), "not executed"),
    Fault("checkpoint: pickle of 100,000 levels", CKPT, lambda f: (f / "old.ckpt").write_bytes(b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."), "old.ckpt"),
    Fault("convert: a scene", "convert scene.ply -o m.safetensors", says="scene.ply"),
    Fault("convert: a training checkpoint of another program", "convert old.ckpt -o m.safetensors", pickled({"kind": torch.zeros(3), "state_dict": {}}), "official"),
    Fault("train: initial weights of another network", TRAIN + " --network.init weights.safetensors --data.workers 0 --perceptual structure", says="weights.safetensors"),
]  # fmt: skip


# Group 6: files (group 5, terminals and signals, is in test_processes.py)


def fifo(name: str) -> Damage:
    def make(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return make


def link(name: str, target: str) -> Damage:
    def make(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(target)

    return make


def unix_socket(name: str) -> Damage:
    def make(folder: Path) -> None:
        (folder / name).unlink()
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(name))

    return make


def resized(width: int, height: int, mode: str = "RGB") -> Damage:
    return lambda folder: Image.new(mode, (width, height)).save(folder / "pair/a.png")


def copy_to_subfolders(folder: Path) -> None:
    for name in ("one", "two"):
        (folder / "flats" / name).mkdir(parents=True)
        for image in (folder / "pair").glob("*.png"):
            (folder / "flats" / name / image.name).write_bytes(image.read_bytes())


def write_nan(folder: Path) -> None:
    import OpenEXR

    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": np.full((16, 32, 3), np.nan, np.float32)}) as file:
        file.write(str(folder / "x.exr"))
    (folder / "x.exr").replace(folder / "pair/a.png")


_PNG_BOMB = bytes.fromhex("89504e470d0a1a0a0000000d49484452000f4240 0007a120 0802000000".replace(" ", "")) + b"\0" * 40

FILES = [
    Fault("a FIFO as a scene", INFO, fifo("scene.ply"), "FIFO"),
    Fault("a FIFO as a scene, viewed", "pansplat-view scene.ply --offscreen out", fifo("scene.ply"), "scene.ply"),
    Fault("a device as a scene", INFO, link("scene.ply", "/dev/zero"), "device"),
    Fault("a socket as a scene", INFO, unix_socket("scene.ply"), "socket"),
    Fault("a link to itself as a scene", INFO, link("scene.ply", "scene.ply"), "scene.ply"),
    Fault("a folder as a scene", "info pair.ply", lambda f: (f / "pair.ply").mkdir(), "folder"),
    Fault("a folder without a suffix as a scene", "info pair", says="pair: needed a scene file, got a folder"),
    *(Fault(f"a file that has no poses: {name}", f"check {name}", text("x", name), f"{name}: needed {needed}")
      for name, needed in (("pair/note.txt", "a panorama, a folder"), ("pair/note.json", "a tour"), ("pair/a.xyz", "a panorama, a folder"))),
    Fault("panoramas without poses in subfolders", "check flats", copy_to_subfolders, "flats: needed panoramas (JPG, PNG, TIFF, WebP or EXR), got some without poses in one, two; open one of these folders, or run `pansplat pose"),
    Fault("a scene with a name of 300 bytes", f"info {_LONG}.ply", says=_LONG),
    Fault("a FIFO as poses", PREDICT, fifo("pair/poses.json"), "pair"),
    Fault("a FIFO as an image", PREDICT, fifo("pair/a.png"), "a.png"),
    Fault("a FIFO as pairs", PREDICT, fifo("pair/pairs.json"), "pair holds 2 pairs", 0),
    Fault("a FIFO as a mask", PREDICT, fifo("pair/a_mask.png"), "", 0),
    Fault("a FIFO as weights", WEIGHTS, fifo("weights.safetensors"), "FIFO"),
    Fault("a FIFO as a pose", "render scene.ply -o x.png --pose p.json", fifo("p.json"), "FIFO"),
    Fault("a FIFO as a pair", "predict fifo -o out.ply", fifo("fifo"), "fifo"),
    Fault("a video", "pose f.mp4 -o poses.json", lambda f: (f / "f.mp4").touch(), "write frames of it into a folder (mkdir FOLDER; ffmpeg"),
    Fault("poses in a missing folder", "pose pair -o no/poses.json", says="existing folder"),
    Fault("poses of an unknown format", "pose pair -o poses.txt", says="--out must end in"),
    Fault("poses of a folder without panoramas", "pose empty -o poses.json", lambda f: (f / "empty").mkdir(), "empty: needed panoramas"),
    Fault("a FIFO as an output", f"{PREDICT.replace('out.ply', 'f.ply')}", fifo("f.ply"), "FIFO"),
    Fault("an output that is a folder", PREDICT.replace("out.ply", "d.ply"), lambda f: (f / "d.ply").mkdir(), "--out d.ply"),
    Fault("an output of 300 bytes", PREDICT.replace("out.ply", f"{_LONG}.ply"), says="too long"),
    Fault("an output of 250 bytes works", PREDICT.replace("out.ply", f"{'a' * 250}.ply"), status=0),
    Fault("an output in /proc", PREDICT.replace("out.ply", "/proc/out.ply"), says="/proc/out.ply"),
    *(Fault(f"{command[:12]}: an output folder {name}", command.format(folder), says=says) for name, folder, says in (
        ("that is a file", "scene.ply", "scene.ply"), ("of 300 bytes", _LONG, "too long"), ("in a file", "scene.ply/a/b", "scene.ply"), ("in /proc", "/proc/a", "/proc")) for command in (
        "evaluate pair --model sphere --height 64 --out {}", "pansplat-train tiny --data.workers 0 --perceptual structure --device cpu --out {}")),
    *(Fault(f"{command[:12]}: an output folder that is a file", command, says="scene.ply") for command in ("bench model --out scene.ply", "pansplat-view scene.ply --offscreen scene.ply")),
    Fault("image: 10^6 x 5 10^5 pixels", PREDICT, lambda f: (f / "pair/a.png").write_bytes(_PNG_BOMB), "a.png"),
    Fault("image: square", PREDICT, resized(32, 32), "2:1"),
    Fault("image: transparent", PREDICT, resized(32, 16, "RGBA"), "a.png"),
    Fault("image: an EXR of NaN", PREDICT, write_nan, "a.png"),
    Fault("image: a folder", PREDICT, lambda f: ((f / "pair/a.png").unlink(), (f / "pair/a.png").mkdir()), "a.png"),
    Fault("image: missing", PREDICT, lambda f: (f / "pair/a.png").unlink(), "a.png"),
    Fault("mask: of a text", PREDICT, lambda f: (f / "pair/a_mask.png").write_text("x"), "a_mask.png"),
    Fault("mask: black", PREDICT, lambda f: Image.new("L", (32, 16)).save(f / "pair/a_mask.png"), "a_mask.png"),
    Fault("a pair that is an empty folder", "predict empty -o out.ply", lambda f: (f / "empty").mkdir(), "empty"),
    Fault("an export without a scene", "export none.spz -o x.ply", says="none.spz: needed a .spz scene"),
    Fault("a scene that is no .spz", "info x.spz", content(b"PK" * 99, "x.spz"), says="got a file that starts with"),
    Fault("a .sog of zeros", "info x.sog", content(b"PK\3\4" + bytes(99), "x.sog"), says="x.sog: needed a complete"),
    Fault("a .splat of 31 bytes", "info x.splat", content(bytes(31), "x.splat"), says="x.splat: needed a complete"),
    Fault("an empty .glb", "render x.glb -o x.png", content(b"", "x.glb"), says="needed a binary glTF file"),
    Fault("a batch of a file", "batch pair/a.png --out out --model sphere", says="a.png: needed a readable folder"),
    *(Fault(f"a batch {name}", f"batch pair --out out --model sphere {options}", says=says) for name, options, says in (
        ("of an unknown step", "--do predict,fly", "got 'fly'"), ("of an unknown format", "--format obj", "--format"), ("of points", "--format ply --gaussians 9", "--gaussians is for"),
        ("with workers of two kinds", "--workers 2 --scheduler tcp://a:1", "leave it out with --scheduler"), ("with no workers", "--workers 0", "--workers"),
        ("of an unknown model", "--model swepe", "got 'swepe'"))),
    Fault("a batch of a folder without panoramas", "batch empty --out out", lambda f: (f / "empty").mkdir(), "empty: needed folders with panoramas"),
    Fault("a batch into a file", "batch pair --out scene.ply", says="--out scene.ply"),
    Fault("a panorama is a pair of one view", "predict pair/a.png -o out.ply", status=0),
    Fault("a pair in the home of an unknown user", "predict ~nobody-at-all/x -o out.ply", says="~nobody-at-all"),
]  # fmt: skip

TABLE = {"scene": SCENES, "size": SIZES, "number": NUMBERS, "checkpoint": CHECKPOINTS, "file": FILES}
FAULTS = [pytest.param(fault, id=f"{group}: {fault.name}") for group, faults in TABLE.items() for fault in faults]


def test_faults_have_distinct_names_and_refusals_a_message() -> None:
    names = [parameter.id for parameter in FAULTS]
    assert len(set(names)) == len(names)
    assert not [fault.name for faults in TABLE.values() for fault in faults if fault.status and not fault.says]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line_with_a_status(fault: Fault, folder: Path, attack: Callable[..., Any]) -> None:
    fault.damage(folder)
    outcome = attack(fault.command.split(" "))
    assert outcome.status == fault.status, outcome
    assert fault.says in outcome.err if fault.says else not outcome.has_error, outcome
    assert not (folder / "executed").exists()
    written = re.search(r"-o (\S+)", fault.command)
    assert written is None or os.path.isfile(folder / written[1]) == (fault.status == 0), outcome


WRITTEN = {
    **{f"x.{suffix}": "render scene.ply --height 64 -o" for suffix in ("exr", "png", "jpg", "webp")},
    "x.mp4": "render scene.ply --height 64 --seconds 0.1 -o",
    **{f"x.{suffix}": "export scene.ply -o" for suffix in ("ply", "compressed.ply", "spz", "splat", "sog", "glb")},
    "y.ply": "predict pair --model sphere --height 64 --refine 0 -o",
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_file_on_a_full_disk_is_one_line_and_the_old_file_stays(
    name: str, folder: Path, attack: Callable[..., Any], full_disk: Callable
) -> None:
    assert attack([*WRITTEN[name].split(), name]).status == 0
    before = (folder / name).read_bytes()
    with full_disk(300):
        outcome = attack([*WRITTEN[name].split(), name, "--overwrite"])  # a .splat states no program
    assert outcome.status == 2 and name in outcome.err and "free disk space" in outcome.err
    assert (folder / name).read_bytes() == before
