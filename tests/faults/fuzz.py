"""Feed damaged files to every reader of the project; test_fuzz.py runs this program in a child process.

A reader may return a value or raise an InputError. Any other exception ends the program with status 1 and names the
reader and the input; a crash of the interpreter ends it by a signal.

Usage: PYTHONPATH=tests python tests/faults/fuzz.py FOLDER NUMBER_OF_INPUTS
"""

from __future__ import annotations

import faulthandler
import json
import random
import shutil
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from panorama_formats import EXAMPLES, Example, write_room
from PIL import Image

from pansplat.cache import CachedScene, _is_valid
from pansplat.cli.render import read_pose
from pansplat.errors import InputError
from pansplat.gaussians.gltf import load_glb, save_glb
from pansplat.gaussians.ply import load_ply
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.images.image_files import read_depth, read_panorama, write_image
from pansplat.inputs.folders import load_pairs, load_panoramas
from pansplat.model.network import build_empty_network, load_predictor
from pansplat.model.weights import WeightsFile, load_weights, read_checkpoint
from pansplat.pipeline import render
from pansplat.system.store import Store
from pansplat.system.strict_json import read_json
from pansplat.training.checkpoint import extract_weights, load_checkpoint

Read = Callable[[Path], object]

_NUMBERS = (b"0", b"-1", b"1e999", b"NaN", b"9" * 25, b"1e30", b"null", b"[", b"{", b'"', b"true", b"\xff", b"\\ud800")


def flip(data: bytes, rng: random.Random) -> bytes:
    """The data with some bytes changed, cut, repeated, or replaced by a hostile token."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(max(1, len(changed)))
        how = rng.randrange(6)
        if how < 2 and changed:
            changed[at] ^= 1 << rng.randrange(8)
        elif how == 2 and changed:
            changed[at] = rng.choice((0, 255, 127, 128))
        elif how == 3:
            changed[at : at + rng.randrange(1, 9)] = rng.choice(_NUMBERS)
        elif how == 4:
            del changed[at : at + rng.randrange(1, 65)]
        else:
            changed[at:at] = changed[at : at + rng.randrange(1, 65)]
    return bytes(changed)


def attempt(name: str, read: Read, path: Path, data: bytes) -> bool:
    """Read a damaged file; returns whether it was accepted."""
    path.write_bytes(data)
    try:
        read(path)
        return True
    except InputError as error:
        if not str(error) or len(str(error)) > 4000:
            raise
        return False
    except BaseException:
        print(f"{name}: the input {data[:300]!r}", file=sys.stderr)
        raise


def draw(scene: Scene) -> None:
    """Draw a small image of a scene, which must be finite."""
    rendering = render(scene, torch.eye(4, dtype=torch.float64), size=(8, 16), blend="joint")
    assert rendering.color.isfinite().all() and rendering.depth.isfinite().all()


def make_example(folder: Path, example: Example) -> tuple[Path, Read]:
    """A file that states panoramas, and a reader of its folder; a web tour is read alone, or pictures were read."""
    example.state(write_room(folder), ("a.png", "b.png"))
    return folder / example.stated, lambda path: load_panoramas(path if example.format == "web tour" else folder)


def make_readers(folder: Path) -> dict[str, tuple[Path, Read]]:
    """By name, an undamaged file and its reader."""
    scene, pair = folder / "scene.ply", folder / "pair"
    small = ("image.png", "image.jpg", "image.webp", "image.tif")
    random_image = np.random.default_rng(0).integers(0, 255, (8, 16, 3), dtype=np.uint8)
    for name in small:
        Image.fromarray(random_image).save(folder / name)
    write_image(folder / "image.exr", random_image)
    Image.fromarray(np.full((8, 16), 999, np.uint16)).save(folder / "depth.png")
    (folder / "pose.txt").write_text("1 0 0 0.5 0 1 0 0 0 0 1 0 0 0 0 1\n")
    (folder / "pose.json").write_text(json.dumps({"convention": "cam2world opencv", "pose": np.eye(4).tolist()}))
    torch.save(
        {
            "kind": "pansplat-training", "format": 1, "step": 3, "config": "{}", "mean": None, "auxiliary": None,
            "weights": json.dumps({"model": "pansplat", "config": {}, "compat": "fixed"}),
            "network": {"a": torch.zeros(3)}, "optimizer": {"state": {}, "param_groups": []},
            "random": torch.zeros(8, dtype=torch.uint8),
        },
        folder / "training.pt",
    )  # fmt: skip
    torch.save({"state_dict": {"encoder.a": torch.zeros(3)}}, folder / "official.ckpt")
    metadata = {"pansplat_format": "1", "model": "pansplat", "config": '{"a": [1, 2]}', "compat": "fixed"}
    tensors = {"a": torch.zeros(3), "b": torch.zeros(2, 2, dtype=torch.float16)}
    safetensors.torch.save_file(tensors, folder / "small.safetensors", metadata)
    (folder / "cached.entry").write_bytes((folder / "cache_body").read_bytes())

    save_glb(load_ply(scene), folder / "scene.glb")

    def read_scene(path: Path) -> None:
        draw(load_ply(path))

    def read_training(path: Path) -> None:
        extract_weights(load_checkpoint(path), path)

    def read_cached(path: Path) -> None:
        body = path.read_bytes()[:-4]  # with a valid checksum, else nothing is parsed
        path.write_bytes(body + zlib.crc32(body).to_bytes(4, "little"))
        if Store(None, (CachedScene, Gaussians))._open(path, lambda content: _is_valid(content, 2)) is None:
            raise InputError("it is predicted again")

    def read_pair(path: Path) -> None:
        del path
        load_pairs(pair)

    return {
        "scene.ply": (scene, read_scene),
        "scene.glb": (folder / "scene.glb", load_glb),
        "poses.json": (pair / "poses.json", read_pair),
        "pairs.json": (pair / "pairs.json", read_pair),
        "pose.txt": (folder / "pose.txt", read_pose),
        "pose.json": (folder / "pose.json", read_pose),
        **{
            f"room {name}": make_example(folder / f"room{number}", example)
            for number, (name, example) in enumerate(EXAMPLES.items())
            if example.format != "photographs"
        },
        "weights": (folder / "small.safetensors", lambda path: load_weights(path)),
        "training checkpoint": (folder / "training.pt", read_training),
        "official checkpoint": (folder / "official.ckpt", lambda path: read_checkpoint(path)),
        "cache": (folder / "cached.entry", read_cached),
        **{
            f"image {name}": (folder / name, lambda path: read_panorama(path, 4))
            for name in (*small, "image.exr")
        },
        "depth": (folder / "depth.png", lambda path: read_depth(path, 4)),
    }  # fmt: skip


_KEYS = ("convention", "poses", "near", "far", "a.png", "b.png", "pairs", "context", "target", "cam2world")
_VALUES = (10**400, 1e300, 1e-300, 0.45, "a.png", "b.png", "cam2world opencv", [[1.0, 0, 0, 0]] * 4)
_SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.sampled_from(_VALUES)
_JSON = st.recursive(
    _SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(_KEYS), inner, max_size=4),
    max_leaves=12,
)


def fuzz_json(folder: Path, count: int) -> None:
    """Valid JSON of other types and numbers in every JSON document."""
    pair = folder / "pair"
    originals = {name: json.loads((pair / name).read_text()) for name in ("poses.json", "pairs.json")}
    settings_of_network = json.loads((folder / "config.json").read_text())

    @settings(
        max_examples=count, deadline=None, database=None, derandomize=True,
        phases=(Phase.generate,), suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(_JSON, st.integers(0, 10**6))
    def check(value: Any, seed: int) -> None:
        rng = random.Random(seed)
        for name, content in originals.items():
            graft(pair / name, content, value, rng)
            with suppress(InputError):
                load_pairs(pair)
            (pair / name).write_text(json.dumps(content))
        graft(folder / "config.tmp", settings_of_network, value, rng)
        with suppress(InputError):
            config = read_json(folder / "config.tmp")
            build_empty_network(WeightsFile("pansplat", config, "fixed", {}), "fixed", "weights")

    check()


def graft(path: Path, content: Any, value: Any, rng: random.Random) -> None:
    """Write the content with one of its parts replaced by a value."""
    copy = json.loads(json.dumps(content))
    holder, key = {"": copy}, ""
    part: Any = copy
    while isinstance(part, (dict, list)) and part and rng.random() < 0.75:
        holder, key = part, rng.choice(list(part)) if isinstance(part, dict) else rng.randrange(len(part))
        part = holder[key]
    holder[key] = value
    path.write_text(json.dumps(copy if key != "" else holder[""]), errors="surrogatepass")


def main() -> None:
    """Fuzz all readers and print the number of accepted inputs and the seconds of each."""
    faulthandler.enable()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    folder, count = Path(sys.argv[1]), int(sys.argv[2])
    readers = make_readers(folder)
    load_predictor(folder / "weights.safetensors")
    for name, (path, read) in readers.items():
        rng, original, began = random.Random(name), path.read_bytes(), time.perf_counter()
        accepted = sum(attempt(name, read, path, flip(original, rng)) for _ in range(count))
        path.write_bytes(original)
        print(f"{name}: {count} inputs, {accepted} accepted, {time.perf_counter() - began:.1f} s", flush=True)
    began = time.perf_counter()
    fuzz_json(folder, count // 10)
    print(f"JSON: {count // 10} inputs, {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    try:
        main()
    except BaseException:
        traceback.print_exc()
        shutil.rmtree(Path(sys.argv[1]), ignore_errors=True)
        sys.exit(1)
