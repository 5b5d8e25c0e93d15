"""Tours of generated homes on disk: linear light, depth and poses of several cameras in each home.

A shard is an .npz file of `TOURS_PER_SHARD` tours. Tour n of a seed is always the same tour. Light is stored as its
square root in 16-bit PNG, depth as millimetres in 16-bit PNG; both are lossless.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy.typing import NDArray

from pansplat.errors import InputError
from pansplat.images.image_files import linear_from_srgb
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import read_json
from pansplat_homes.library import FurnitureLibrary, load_furniture

TOURS_PER_SHARD = 16
_FORMAT = 1
_MEDIAN_LIGHT = 0.2  # of a stored tour
_MAX_LIGHT = 64.0
_MILLIMETRES = 1000.0
_LARGEST = 65535


@dataclass(frozen=True, eq=False)
class Tour:
    """Panoramas of one place.

    Attributes:
        light: (view h w 3) linear light, float32; its median is 0.2.
        depth: (view h w) radial depth in metres, float32; 0 where it is unknown.
        cam2world: (view 4 4) float64.
        camera_height: (view) height over the floor in metres, float64.
    """

    light: NDArray[np.float32]
    depth: NDArray[np.float32]
    cam2world: NDArray[np.float64]
    camera_height: NDArray[np.float64]


@dataclass(frozen=True)
class TourSettings:
    """What a folder of shards contains.

    Attributes:
        seed: seed of the homes.
        height: height of the panoramas, pixels.
        cameras: cameras in each home.
        samples: `samples` squared is the number of rays per pixel.
        furniture: a folder with catalogues of Sweet Home 3D, or None for our own furniture only.
    """

    seed: int = 0
    height: int = 128
    cameras: int = 4
    samples: int = 2
    furniture: Path | None = None


def render_tour(settings: TourSettings, index: int) -> Tour:
    """Tour `index` of a seed."""
    from pansplat_homes.homes import build_home

    rng = np.random.default_rng((settings.seed, index))
    library = None if settings.furniture is None else load_library(settings.furniture)
    cameras = []
    while len(cameras) < settings.cameras:
        home = build_home(rng, library)
        cameras = home.sample_cameras(rng, settings.cameras)
    views = [home.variants[variant].panorama(pose, settings.height, settings.samples) for variant, pose in cameras]
    light = np.stack([view[0] for view in views]).astype(np.float32)
    light *= _MEDIAN_LIGHT / max(float(np.median(light)), 1e-4)
    poses = np.stack([pose for _, pose in cameras])
    return Tour(light, np.stack([view[1] for view in views]).astype(np.float32), poses, -poses[:, 1, 3])


def write_shards(
    folder: Path, count: int, settings: TourSettings, *, workers: int = 1, progress: Callable[[int], None] | None = None
) -> int:
    """Write the shards of tours 0 to `count` - 1, rounded up to whole shards, and return the number of new shards.

    Shards that are there are kept, so that an interrupted call can be repeated.

    Args:
        progress: called with the number of tours in the shards that are there, and in each new one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    _claim_folder(folder, settings)
    numbers = range(-(-count // TOURS_PER_SHARD))
    missing = [n for n in numbers if not _shard_path(folder, n).exists()]
    report = progress or (lambda tours: None)
    report(TOURS_PER_SHARD * (len(numbers) - len(missing)))
    tasks = [(folder, settings, n) for n in missing]
    for _ in _run_tasks(tasks, workers):
        report(TOURS_PER_SHARD)
    return len(missing)


def pack_triplets(source: Path, folder: Path, height: int) -> int:
    """Write shards of rendered triplets of game maps, and return their number of tours; a last part is left out.

    Args:
        source: files NAME_0.png to NAME_2.png (sRGB), NAME_0_depth.png to NAME_2_depth.png (millimetres, 16 bit), and
            NAME.json with "c2w", three poses in metres with y down.
    """
    names = sorted(path.with_suffix("") for path in source.glob("*.json"))
    names = names[: len(names) // TOURS_PER_SHARD * TOURS_PER_SHARD]
    if not names:
        raise InputError(f"{source}: needed at least {TOURS_PER_SHARD} rendered triplets, got fewer; render more.")
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(len(names) // TOURS_PER_SHARD):
        chosen = names[number * TOURS_PER_SHARD : (number + 1) * TOURS_PER_SHARD]
        _save_shard(_shard_path(folder, number), (_read_triplet(name, height) for name in chosen))
    return len(names)


def _read_triplet(name: Path, height: int) -> Tour:
    """The tour of a rendered triplet; the height of each camera over the floor is the depth at the nadir."""
    try:
        poses = np.array(read_json(name.with_suffix(".json"))["c2w"], np.float64)
        images = [_read_png(f"{name}_{n}.png", cv2.IMREAD_COLOR)[..., ::-1] for n in range(3)]
        depths = [_read_png(f"{name}_{n}_depth.png", cv2.IMREAD_UNCHANGED) / _MILLIMETRES for n in range(3)]
    except (OSError, ValueError, KeyError, TypeError, cv2.error) as error:
        raise InputError(f"{name}: needed a rendered triplet, got {error!r}; render it again.") from error
    size = (2 * height, height)
    light = linear_from_srgb(np.stack([cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in images]) / 255)
    light *= _MEDIAN_LIGHT / max(float(np.median(light)), 1e-4)
    depth = np.stack([cv2.resize(d, size, interpolation=cv2.INTER_NEAREST) for d in depths])
    floor = [float(np.median(view[-height // 16 :])) for view in depth]
    return Tour(light.astype(np.float32), depth.astype(np.float32), poses, np.maximum(floor, 0.3))


def _read_png(path: str, flags: int) -> Any:
    """The pixels of a file. `cv2.imread` reads no names outside of the code page of Windows."""
    return cv2.imdecode(np.fromfile(path, np.uint8), flags)


class ShardReader:
    """The tours of one or more folders of shards, by index."""

    def __init__(self, folders: list[Path]) -> None:
        self.paths: list[Path] = []
        for folder in folders:
            found = sorted(folder.glob("shard_*.npz"))
            if not found:
                raise InputError(f"{folder}: needed shards of tours, got none; make them by `pansplat-homes homes`.")
            self.paths += found
        self._per_shard = TOURS_PER_SHARD

    def __len__(self) -> int:
        return self._per_shard * len(self.paths)

    def read(self, index: int) -> Tour:
        """Tour `index`."""
        shard, place = divmod(index, self._per_shard)
        path = self.paths[shard]
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as shard_file:
                lights = [_decode(png) for png in _unpack(shard_file[f"{place}.light"])]
                depths = [_decode(png) for png in _unpack(shard_file[f"{place}.depth"])]
                poses, heights = shard_file[f"{place}.cam2world"], shard_file[f"{place}.camera_height"]
            light, depth = np.stack(lights).astype(np.float32) / _LARGEST, np.stack(depths) / np.float32(_MILLIMETRES)
        except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, cv2.error) as error:
            raise InputError(f"{path}: needed a shard of tours, got {error!r}; delete it and make it again.") from error
        return Tour(light * light * _MAX_LIGHT, depth, poses, heights)


@functools.cache
def load_library(folder: Path) -> FurnitureLibrary:
    """The furniture in a folder, with a cache there if it is writable."""
    cache = folder / "pansplat_furniture.npz"
    return load_furniture(folder, cache if cache.exists() or os.access(folder, os.W_OK) else None)


def _run_tasks(tasks: list[tuple[Path, TourSettings, int]], workers: int) -> Iterator[None]:
    if workers <= 1:
        yield from map(_write_shard, tasks)
        return
    ignore = (signal.SIGINT, signal.SIG_IGN)  # after Ctrl+C this process ends the others
    with get_context("spawn").Pool(workers, signal.signal, ignore) as pool:
        yield from pool.imap_unordered(_write_shard, tasks)


def _write_shard(task: tuple[Path, TourSettings, int]) -> None:
    folder, settings, number = task
    first = number * TOURS_PER_SHARD
    tours = (render_tour(settings, index) for index in range(first, first + TOURS_PER_SHARD))
    _save_shard(_shard_path(folder, number), tours)


def _save_shard(path: Path, tours: Iterable[Tour]) -> None:
    arrays: dict[str, NDArray] = {}
    for place, tour in enumerate(tours):
        code = np.sqrt(np.clip(tour.light, 0, _MAX_LIGHT) / _MAX_LIGHT) * _LARGEST
        arrays[f"{place}.light"] = _pack([_encode(view) for view in code])
        arrays[f"{place}.depth"] = _pack([_encode(np.minimum(view * _MILLIMETRES, _LARGEST)) for view in tour.depth])
        arrays[f"{place}.cam2world"], arrays[f"{place}.camera_height"] = tour.cam2world, tour.camera_height
    with replacing(path) as partial, open(partial, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _shard_path(folder: Path, number: int) -> Path:
    return folder / f"shard_{number:05d}.npz"


def _claim_folder(folder: Path, settings: TourSettings) -> None:
    """Write the settings into the folder, or check that they are those of its shards."""
    path = folder / "settings.json"
    text = json.dumps({"format": _FORMAT, **settings.__dict__, "furniture": settings.furniture is not None}, indent=1)
    if path.exists() and path.read_text("utf-8") != text:
        raise InputError(f"{folder}: needed a folder with shards of the same settings, got others; see {path}.")
    with replacing(path) as partial:
        partial.write_text(text, "utf-8")


def _encode(image: Float[NDArray, "height width *channel"]) -> NDArray[np.uint8]:
    done, png = cv2.imencode(".png", np.rint(image).astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 4])
    assert done
    return png.ravel()


def _decode(png: NDArray[np.uint8]) -> Float32[NDArray, "height width *channel"]:
    image = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("a damaged PNG")
    return image


def _pack(parts: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Join byte strings of any length into one array: their count and lengths first."""
    lengths = np.array([len(parts), *(len(part) for part in parts)], "<u4")
    return np.concatenate((lengths.view(np.uint8), *parts))


def _unpack(packed: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    count = int(packed[:4].view("<u4")[0])
    lengths = packed[4 : 4 + 4 * count].view("<u4").astype(np.int64)
    ends = 4 + 4 * count + np.cumsum(lengths)
    return [packed[end - length : end] for end, length in zip(ends, lengths, strict=True)]
