"""Models of COLMAP, text or binary: equirectangular cameras, and pinhole ones of which rigs show all directions.

Poses are world2cam with OpenCV axes, as quaternions wxyz and translations. Pixel centres are at half-integers.

Source: https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray as Array
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.pose import invert_pose, quats_from_rotations, rotations_from_quats
from pansplat.images.rig_images import Lens
from pansplat.inputs.reconstructions.shots import Reconstruction, find_picture
from pansplat.system.files import SOFTWARE, read_file

_T = TypeVar("_T")

CONVENTION = "world2cam opencv"
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")

_MODELS = (  # name and number of parameters of each camera model, by COLMAP's number
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4),
    ("EUCM", 6), ("EQUIRECTANGULAR", 2),
)  # fmt: skip
_FOCALS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2}
_MAX_BYTES = 1 << 31  # bytes of the largest file that is read
_MAX_POINTS = 200_000  # points that are read to find near and far
_MAX_NAME = 4096  # bytes of the longest name of a picture
_NOT_COMPUTED = -1  # what a point's error is where it is not known

_Camera = tuple[str, int, int, list[float]]  # model, width, height, parameters
_Image = tuple[list[float], list[float], int, str]  # quaternion, translation, camera, name


def list_files(source: Path) -> list[Path]:
    """The files of a model, from its images file."""
    return [source.with_stem(name) for name in ("images", "cameras", "points3D")]


def find_colmap(folder: Path) -> list[Path]:
    """The images file of the model in a folder, if there is one. A model needs its cameras file, too."""
    for sub in MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            images, cameras, _ = list_files(folder / sub / f"images{suffix}")
            if images.is_file() and cameras.is_file():
                return [images]
    return []


def read_colmap(source: Path, folder: Path, convention: str | None = None) -> Reconstruction:
    """The pictures of a model."""
    read_cameras, read_images, read_points = _BINARY if source.suffix == ".bin" else _TEXT
    images_file, cameras_file, points_file = list_files(source)
    cameras = _parse(cameras_file, read_cameras)
    images = _parse(images_file, lambda file: list(read_images(file)))
    if not images:
        raise InputError(f"{source}: needed posed pictures, got none; export the model again.")
    project = next((place.parent for place in (source.parent, source.parent.parent) if place.name == "sparse"), folder)
    found = Reconstruction(source, folder, convention or CONVENTION)
    for quat, translation, camera, name in images:
        where = f"{source}, {name!r}"
        if camera not in cameras:
            raise InputError(f"{where}: needed camera {camera} in {cameras_file.name}, got none; export it again.")
        image = find_picture(folder, name, project / "images")
        lens = None if image is None else _make_lens(cameras[camera], where)
        rotation = rotations_from_quats(torch.tensor(quat, dtype=torch.float64)).numpy()
        found.add(name, image, np.column_stack((rotation, translation)), lens)
    if points_file.is_file():
        points = _parse(points_file, lambda file: np.array(list(islice(read_points(file), _MAX_POINTS))).reshape(-1, 3))
        found.points = points[np.isfinite(points).all(axis=1)]
    return found


def _parse(file: Path, read: Callable[[Path], _T]) -> _T:
    """What a reader returns for a file of a model; an InputError names a damaged one."""
    try:
        return read(file)
    except (ValueError, IndexError, KeyError, OverflowError, struct.error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{file}: needed a complete file of a model of COLMAP, got damaged data ({error}); export it again."
        ) from error


def _make_lens(camera: _Camera, where: str) -> Lens | None:
    model, width, height, parameters = camera
    if model == "EQUIRECTANGULAR":
        return None
    focals = _FOCALS.get(model)
    if focals is None:
        raise InputError(
            f"{where}: needed an equirectangular or a pinhole camera without distortion, got {model}; "
            "undistort the pictures first (colmap image_undistorter)."
        )
    fx, fy, (cx, cy) = parameters[0], parameters[focals - 1], parameters[focals : focals + 2]
    if not (min(fx, fy) > 0 and min(width, height) > 0):
        raise InputError(f"{where}: needed a positive focal length and size, got {fx}, {fy}, {width}x{height}.")
    return Lens(fx, fy, cx, cy, width, height)


# Text


def _lines(path: Path) -> list[str]:
    text = read_file(path, limit=_MAX_BYTES).decode("utf-8-sig")
    return [line for line in text.splitlines() if not line.startswith("#")]


def _read_cameras_text(path: Path) -> dict[int, _Camera]:
    rows = [line.split() for line in _lines(path) if line.strip()]
    return {int(row[0]): (row[1], int(row[2]), int(row[3]), [float(x) for x in row[4:]]) for row in rows}


def _read_images_text(path: Path) -> Iterator[_Image]:
    lines = iter(_lines(path))
    for line in lines:
        if not line.strip():
            continue
        row = line.split(maxsplit=9)
        numbers = [float(x) for x in row[1:8]]
        yield numbers[:4], numbers[4:], int(row[8]), row[9].strip()
        next(lines, None)  # this line lists the points in the picture


def _read_points_text(path: Path) -> Iterator[list[float]]:
    return ([float(x) for x in line.split(maxsplit=4)[1:4]] for line in _lines(path) if line.strip())


# Binary


class _Cursor:
    """Little-endian values of a file, one after another."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = read_file(path, limit=_MAX_BYTES), 0

    def read(self, kinds: str) -> tuple[Any, ...]:
        values = struct.unpack_from(f"<{kinds}", self.data, self.at)
        self.at += struct.calcsize(f"<{kinds}")
        return values

    def read_string(self) -> str:
        end = self.data.index(b"\0", self.at, self.at + _MAX_NAME)
        text, self.at = self.data[self.at : end].decode(), end + 1
        return text


def _read_cameras_binary(path: Path) -> dict[int, _Camera]:
    cursor, cameras = _Cursor(path), {}
    for _ in range(cursor.read("Q")[0]):
        number, model, width, height = cursor.read("IiQQ")
        name, count = _MODELS[model] if model >= 0 else ("unknown", 0)
        cameras[number] = (name, width, height, list(cursor.read(f"{count}d")))
    return cameras


def _read_images_binary(path: Path) -> Iterator[_Image]:
    cursor = _Cursor(path)
    for _ in range(cursor.read("Q")[0]):
        _, *numbers, camera = cursor.read("I7dI")
        name = cursor.read_string()
        (count,) = cursor.read("Q")
        cursor.at += 24 * count
        yield numbers[:4], numbers[4:], camera, name


def _read_points_binary(path: Path) -> Iterator[list[float]]:
    cursor = _Cursor(path)
    for _ in range(cursor.read("Q")[0]):
        _, *point, _, _, _, _, track = cursor.read("Q3d3BdQ")
        cursor.at += 8 * track
        yield point


_TEXT = _read_cameras_text, _read_images_text, _read_points_text
_BINARY = _read_cameras_binary, _read_images_binary, _read_points_binary


def write_colmap(
    folder: Path,
    rigs: Sequence[Sequence[tuple[str, Float[Tensor, "4 4"], Lens]]],
    points: Float[Array, "point 3"],
    colors: UInt8[Array, "point 3"],
) -> None:
    """Write a model in text: pictures of rigs, which share the cameras of equal lenses, and points without tracks.

    Args:
        folder: exists; gets rigs.txt, cameras.txt, frames.txt, images.txt and points3D.txt.
        rigs: name, cam2world (OpenCV axes) and lens of each picture taken at one place.
        points: positions.
        colors: 8-bit sRGB.
    """
    kinds = list(dict.fromkeys(tuple(lens for _, _, lens in pictures) for pictures in rigs))
    starts = np.cumsum([1, *(len(lenses) for lenses in kinds)]).tolist()  # the first camera of each kind of rig
    cameras, sensors, frames, images = [], [], [], []
    for number, lenses in enumerate(kinds):
        for camera, lens in enumerate(lenses, starts[number]):
            numbers = (lens.fx, lens.fy, lens.cx, lens.cy)
            cameras.append(f"{camera} PINHOLE {lens.width} {lens.height} {_join(numbers)}")
        pictures = next(p for p in rigs if tuple(lens for _, _, lens in p) == lenses)
        reference = pictures[0][1]
        others = (
            f"CAMERA {camera} 1 {_join(_format_pose(invert_pose(pose) @ reference))}"
            for camera, (_, pose, _) in enumerate(pictures[1:], starts[number] + 1)
        )
        sensors.append(" ".join((f"{number + 1} {len(lenses)} CAMERA {starts[number]}", *others)))
    image = 0
    for frame, pictures in enumerate(rigs, start=1):
        kind = kinds.index(tuple(lens for _, _, lens in pictures))
        members = []
        for camera, (name, pose, _) in enumerate(pictures, starts[kind]):
            image += 1
            images += [f"{image} {_join(_format_pose(invert_pose(pose)))} {camera} {name}", ""]
            members.append(f"CAMERA {camera} {image}")
        pose = _join(_format_pose(invert_pose(pictures[0][1])))
        frames.append(f"{frame} {kind + 1} {pose} {len(members)} {' '.join(members)}")
    table = [
        f"{number} {x:.10g} {y:.10g} {z:.10g} {r} {g} {b} {_NOT_COMPUTED}"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(points.tolist(), colors.tolist(), strict=True), start=1)
    ]
    files = {"rigs": sensors, "cameras": cameras, "frames": frames, "images": images, "points3D": table}
    for name, lines in files.items():
        (folder / f"{name}.txt").write_text("\n".join([f"# {SOFTWARE}", *lines, ""]), encoding="utf-8")


def _format_pose(pose: Float[Tensor, "4 4"]) -> list[float]:
    return [*quats_from_rotations(pose[:3, :3].double()).tolist(), *pose[:3, 3].tolist()]


def _join(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)
