# ruff: noqa: E501  # a fault is one line
"""The table of faults: each is one line that names the file or the option, a status, and no half-written file.

Numbers of all options, and damaged files of all kinds, are in test_command_numbers.py and test_input_files.py.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

Damage = Callable[[Path], object]
_LONG = "a" * 300
_HUGE = 10**400


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


def content(data: bytes | Callable[[bytes], bytes], name: str = "scene.ply") -> Damage:
    def write(folder: Path) -> None:
        path = folder / name
        path.write_bytes(data if isinstance(data, bytes) else data(path.read_bytes()))

    return write


def far_away(data: bytes) -> bytes:
    """All numbers of all vertices are -3e38."""
    head, body = data.split(b"end_header\n")
    return head + b"end_header\n" + np.full(len(body) // 4, -3e38, "<f4").tobytes()


SCENES = [
    Fault("file: a picture", INFO, lambda folder: (folder / "scene.ply").write_bytes((folder / "pair/a.png").read_bytes()), "not a .ply"),
    Fault("file: cut in the header, viewed", "pansplat-view scene.ply --offscreen out", content(lambda data: data[:100]), "scene.ply"),
    Fault("vertices: -3e38, as a page", "export scene.ply -o tour.html", content(far_away), "no visible Gaussians"),
    Fault("vertices: -3e38, drawn", DRAW, content(far_away), "", 0),
    Fault("a page over a file named like its folder", "export scene.ply -o tour", lambda folder: ((folder / "tour").mkdir(), (folder / "tour/index_files").write_text("")), "index_files"),
]  # fmt: skip


TRAIN = "pansplat-train tiny --out run --device cpu"

OPTIONS = [
    Fault("an option without its number", "predict pair -o out.ply --height", says="--height"),
    Fault("a number of 5,000 digits", f"predict pair -o out.ply --height {'9' * 5000}", says="--height"),
    Fault("an option that is missing", "predict pair", says="--out"),
    Fault("a misspelt option", "predict pair -o out.ply --heigth 64", says="--height"),
    Fault("a choice that is missing", "render scene.ply -o x.png --layout fisheye", says="--layout"),
    Fault("a number of a view with 400 digits", f"render scene.ply -o x.png --blend view{_HUGE}", says="--blend"),
    Fault("a number of a pair with 400 digits", f"{PREDICT} --pair {_HUGE}", says="--pair"),
    Fault("stereo of a perspective image", "render scene.ply --stereo --layout perspective -o x.png", says="--stereo is for"),
    Fault("too many Gaussians of a page", "export scene.ply -o tour.html --gaussians 5000000", says="4,000,000 in a page"),
    Fault("a distance of 0 metres", "pose pair --baseline a.png b.png 0", says="`baseline` must be"),
    Fault("a distance of one panorama", "pose pair --baseline a.png a.png 1", says="`baseline` must be"),
    Fault("a distance of a missing panorama", "pose pair --baseline a.png x.png 1", says="x.png"),
    Fault("a distance without a number", "pose pair --baseline a.png b.png", says="--baseline"),
    *(Fault(f"view {options}", f"pansplat-view scene.ply {options}", says=says) for options, says in (
        ("--size huge", "WIDTHxHEIGHT"), ("--pair kitchen", "number from 1 to 1 or one of scene"), ("--path no.json", "no.json"))),
    Fault("view: a scene that is missing", "pansplat-view nowhere", says="no such file or folder"),
    *(Fault(f"train {options}", f"pansplat-train {options} --device cpu --data.workers 0 --perceptual structure", says=says) for options, says in (
        ("small", "needs --data.root"), ("tiny --data.root nowhere", "needs no --data.root"), ("pansplat-256 --data.root nowhere", "--network.init"), ("tiny --network.init none.safetensors", "none.safetensors"), ("", "tiny"),
        ("gigantic", "gigantic"), ("tiny --optimizer.stepps 3", "--optimizer.steps"), ("tiny --memory.backpropagation three-step", "two-step"))),
    *(Fault(f"bench {options}", f"bench {options}", says=says) for options, says in (
        ("raster --height 20", "multiple of 8"), ("raster none.ply", "none.ply"), ("model --height 80", "multiple of 64"), ("model --pair nowhere", "nowhere is not a folder"),
        ("model --height 64 --model none.safetensors", "none.safetensors"))),
]  # fmt: skip


def text(value: str, name: str) -> Damage:
    return lambda folder: (folder / name).write_text(value)


def many_panoramas(folder: Path) -> None:
    """A pair of 1,000 context panoramas."""
    content = json.loads((folder / "pair/poses.json").read_text())
    for number in range(1000):
        os.symlink("a.png", folder / "pair" / f"v{number}.png")
        content["poses"][f"v{number}.png"] = [[1, 0, 0, number], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (folder / "pair/poses.json").write_text(json.dumps(content))
    pairs = {"pairs": [{"context": [f"v{number}.png" for number in range(1000)]}]}
    (folder / "pair/pairs.json").write_text(json.dumps(pairs))


WEIGHTS_FILES = [
    Fault("pairs: 1,000 context panoramas", PREDICT, many_panoramas, "at most 64"),
    Fault("weights: bytes", WEIGHTS, content(b"PK" * 99, "weights.safetensors"), "weights.safetensors"),
    Fault("weights: a scene", "predict pair -o out.ply --model scene.ply", says="`model`"),
    Fault("weights: foreign tensors", "predict pair -o out.ply --model old.ckpt --height 64", lambda folder: torch.save({"state_dict": {"a": torch.zeros(1)}}, folder / "old.ckpt"), "official"),
    Fault("convert: a scene", "convert scene.ply -o m.safetensors", says="scene.ply"),
    Fault("train: initial weights of another network", TRAIN + " --network.init weights.safetensors --data.workers 0 --perceptual structure", says="weights.safetensors"),
]  # fmt: skip


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


def resized(width: int, height: int, mode: str = "RGB") -> Damage:
    return lambda folder: Image.new(mode, (width, height)).save(folder / "pair/a.png")


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
    Fault("a folder as a scene", "info pair.ply", lambda f: (f / "pair.ply").mkdir(), "folder"),
    Fault("a folder without a suffix as a scene", "info pair", says="pair: needed a scene file, got a folder"),
    *(Fault(f"a file that has no poses: {name}", f"check {name}", text("x", name), f"{name}: needed {needed}")
      for name, needed in (("pair/note.txt", "a panorama, a folder"), ("pair/note.json", "a tour"), ("pair/a.xyz", "a panorama, a folder"))),
    Fault("a scene with a name of 300 bytes", f"info {_LONG}.ply", says=_LONG),
    Fault("a FIFO as poses", PREDICT, fifo("pair/poses.json"), "pair"),
    Fault("a FIFO as an image", PREDICT, fifo("pair/a.png"), "a.png"),
    Fault("a FIFO as weights", WEIGHTS, fifo("weights.safetensors"), "FIFO"),
    Fault("a video", "pose f.mp4 -o poses.json", lambda f: (f / "f.mp4").touch(), "write frames of it into a folder (mkdir FOLDER; ffmpeg"),
    Fault("poses in a missing folder", "pose pair -o no/poses.json", says="existing folder"),
    Fault("poses of a folder without panoramas", "pose empty -o poses.json", lambda f: (f / "empty").mkdir(), "empty: needed panoramas"),
    Fault("a FIFO as an output", f"{PREDICT.replace('out.ply', 'f.ply')}", fifo("f.ply"), "FIFO"),
    Fault("an output that is a folder", PREDICT.replace("out.ply", "d.ply"), lambda f: (f / "d.ply").mkdir(), "--out d.ply"),
    Fault("an output of 300 bytes", PREDICT.replace("out.ply", f"{_LONG}.ply"), says="too long"),
    *(Fault(f"{command[:12]}: an output folder {name}", command.format(folder), says=says) for name, folder, says in (
        ("that is a file", "scene.ply", "scene.ply"), ("of 300 bytes", _LONG, "too long"), ("in a file", "scene.ply/a/b", "scene.ply"), ("in /proc", "/proc/a", "/proc")) for command in (
        "evaluate pair --model sphere --height 64 --out {}", "pansplat-train tiny --data.workers 0 --perceptual structure --device cpu --out {}")),
    Fault("view: an output folder that is a file", "pansplat-view scene.ply --offscreen scene.ply", says="scene.ply"),
    Fault("image: 10^6 x 5 10^5 pixels", PREDICT, lambda f: (f / "pair/a.png").write_bytes(_PNG_BOMB), "a.png"),
    Fault("image: square", PREDICT, resized(32, 32), "2:1"),
    Fault("image: transparent", PREDICT, resized(32, 16, "RGBA"), "a.png"),
    Fault("image: an EXR of NaN", PREDICT, write_nan, "a.png"),
    Fault("image: a folder", PREDICT, lambda f: ((f / "pair/a.png").unlink(), (f / "pair/a.png").mkdir()), "a.png"),
    Fault("mask: of a text", PREDICT, lambda f: (f / "pair/a_mask.png").write_text("x"), "a_mask.png"),
    Fault("a pair that is an empty folder", "predict empty -o out.ply", lambda f: (f / "empty").mkdir(), "empty"),
    Fault("an export without a scene", "export none.spz -o x.ply", says="none.spz: needed a .spz scene"),
    Fault("a batch of a file", "batch pair/a.png --out out --model sphere", says="a.png: needed a readable folder"),
    *(Fault(f"a batch {name}", f"batch pair --out out --model sphere {options}", says=says) for name, options, says in (
        ("of an unknown step", "--do predict,fly", "got 'fly'"), ("of an unknown format", "--format obj", "--format"), ("of points", "--format ply --gaussians 9", "--gaussians is for"),
        ("with workers of two kinds", "--workers 2 --scheduler tcp://a:1", "leave it out with --scheduler"), ("with no workers", "--workers 0", "--workers"),
        ("of an unknown model", "--model swepe", "got 'swepe'"))),
    Fault("a batch of a folder without panoramas", "batch empty --out out", lambda f: (f / "empty").mkdir(), "empty: needed folders with panoramas"),
    Fault("a pair in the home of an unknown user", "predict ~nobody-at-all/x -o out.ply", says="~nobody-at-all"),
]  # fmt: skip

TABLE = {"scene": SCENES, "option": OPTIONS, "weights": WEIGHTS_FILES, "file": FILES}
FAULTS = [pytest.param(fault, id=f"{group}: {fault.name}") for group, faults in TABLE.items() for fault in faults]


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line_with_a_status(fault: Fault, folder: Path, attack: Callable[..., Any]) -> None:
    fault.damage(folder)
    outcome = attack(fault.command.split(" "))
    assert outcome.status == fault.status, outcome
    assert fault.says in outcome.err if fault.says else not outcome.has_error, outcome
    written = re.search(r"-o (\S+)", fault.command)
    assert written is None or os.path.isfile(folder / written[1]) == (fault.status == 0), outcome


WRITTEN = {
    **{f"x.{suffix}": "render scene.ply --height 64 -o" for suffix in ("exr", "png", "jpg", "webp")},
    "x.mp4": "render scene.ply --height 64 --seconds 0.1 -o",
    **{f"x.{suffix}": "export scene.ply -o" for suffix in ("ply", "compressed.ply", "spz", "splat", "sog", "glb")},
    "y.ply": "predict pair --model sphere --height 64 --refine 0 -o",
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_file_on_a_full_disk_is_one_line_and_the_old_file_stays(name: str, folder, attack, full_disk) -> None:
    assert attack([*WRITTEN[name].split(), name]).status == 0
    before = (folder / name).read_bytes()
    with full_disk(300):
        outcome = attack([*WRITTEN[name].split(), name, "--overwrite"])  # a .splat states no program
    assert outcome.status == 2 and name in outcome.err and "free disk space" in outcome.err
    assert (folder / name).read_bytes() == before
