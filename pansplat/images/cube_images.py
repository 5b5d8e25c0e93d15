"""Panoramas that are stored as six cube faces, whole or in tiles of several levels, and read as equirectangular ones.

Everything in the package names a panorama by one file. For a cube this is a small JSON file in a cache folder (suffix
`CUBE_SUFFIX`) that names the pictures of each level. Only the lowest level that is large enough is decoded.

Convention: faces in the order of `pansplat.geometry.cubemap.FACES`, pixel centres at half-integers. Rows of tiles count
from the top. The bottom edge of the upper face, and the top edge of the lower one, touch the front face.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from msgspec import Meta
from numpy import ndarray as Array

from pansplat.errors import InputError
from pansplat.geometry.cubemap import face_of, face_rotations
from pansplat.system.files import read_file
from pansplat.system.store import cache_folders, hash_parts, write_cache_file

CUBE_SUFFIX = ".cube.json"
BESIDE = "beside"  # key of a file that stands for a panorama: the folder of what belongs to it, such as masks
ROW, COLUMN = "{row}", "{column}"  # in the path of a face: numbers of a tile, from 0

Decode = Callable[[Path], UInt8[Array, "rows columns 3"]]

LARGEST_DENSITY, DENSITY = 1.5, 1.28  # face pixels for one of the panorama: faces with more are reduced to the second
MAX_SIZE = 8000  # pixels along a face; OpenCV resamples at most 32,767 rows
_MIN_HEIGHT = 4  # rows of a panorama from which on every face has rows and columns
_FRAME = 2  # pixels around a face that the cubic filter takes from the neighbouring faces
_SAMPLES = 2  # samples per pixel and axis; faces are up to twice as dense at their edges as a panorama
DENSE_FACE = 2 / math.pi  # face size over panorama height at which the centre of a face is as dense as the panorama
_CAP = 0.6  # radians; beyond it a column may meet the upper or lower face; the cube's corners are at 0.615


@dataclass(frozen=True)
class CubeLevel:
    """The pictures of one size.

    Attributes:
        size: along a face, pixels.
        tile: along a tile, pixels; tiles of the last row and column may be smaller.
        faces: paths relative to the cube's folder, with `ROW` and `COLUMN` for tiles.
    """

    size: Annotated[int, Meta(ge=1, le=MAX_SIZE)]
    tile: Annotated[int, Meta(ge=1)]
    faces: Annotated[tuple[str, ...], Meta(min_length=6, max_length=6)]

    def list_files(self) -> Iterator[str]:
        """Relative paths of all pictures."""
        for face in self.faces:
            for row, column in self._list_tiles():
                yield _name_tile(face, row, column)

    def _list_tiles(self) -> Iterator[tuple[int, int]]:
        count = -(-self.size // self.tile)
        return ((row, column) for row in range(count) for column in range(count))

    def read(self, folder: Path, decode: Decode) -> list[UInt8[Array, "size size 3"]]:
        """Read the six faces of the cube."""
        return [self._read_face(face, folder, decode) for face in self.faces]

    def _read_face(self, face: str, folder: Path, decode: Decode) -> UInt8[Array, "size size 3"]:
        pixels = np.empty((self.size, self.size, 3), np.uint8)
        for row, column in self._list_tiles():
            top, left = row * self.tile, column * self.tile
            target = pixels[top : top + self.tile, left : left + self.tile]
            tile = decode(folder / _name_tile(face, row, column))
            if tile.shape != target.shape:
                tile = cv2.resize(tile, target.shape[1::-1], interpolation=cv2.INTER_AREA)
            target[:] = tile
        return pixels


def _name_tile(face: str, row: int, column: int) -> str:
    return face.replace(ROW, str(row)).replace(COLUMN, str(column))


@dataclass(frozen=True)
class CubeImage:
    """A panorama of cube faces.

    Attributes:
        folder: the folder that holds the pictures.
        levels: complete ones, the smallest first.
    """

    folder: Path
    levels: Annotated[tuple[CubeLevel, ...], Meta(min_length=1)]

    @property
    def height(self) -> int:
        """Height of the equirectangular panorama that has the detail of the largest level, pixels."""
        return 2 * self.levels[-1].size

    def list_files(self) -> Iterator[Path]:
        """The files of all pictures of the cube, of each level."""
        return (self.folder / file for level in self.levels for file in level.list_files())

    def read(self, height: int, decode: Decode) -> tuple[UInt8[Array, "height width 3"], None]:
        """The equirectangular panorama at (height, 2 height); None, as the pictures show all of it."""
        level = next((level for level in self.levels if level.size >= DENSE_FACE * height), self.levels[-1])
        return equirect_from_faces(level.read(self.folder, decode), height), None


def write_cube(cube: CubeImage, folder: Path, name: str) -> Path:
    """Write the file that stands for a cube; see `write_description`."""
    return write_description(dataclasses.replace(cube, folder=cube.folder.resolve()), folder, name + CUBE_SUFFIX)


def write_description(panorama: Any, folder: Path, name: str) -> Path:
    """Write a file that stands for a panorama, if it has changed; it changes with every picture's time or size.

    Args:
        panorama: a dataclass of whole paths, whose `list_files` are the pictures; its fields are the content.
        folder: the tour's; the file is written in its cache folder.
        name: valid as a file name. The file is in a folder of its content: tours of one folder may have equal names.
    """
    content = dataclasses.asdict(panorama) | {BESIDE: folder.resolve()}
    name = f"{hash_parts(json.dumps(content, default=str))}/{name}"
    digest = hashlib.blake2b(digest_size=12)
    for picture in panorama.list_files():
        status = os.stat(picture)
        digest.update(b"%d %d;" % (status.st_size, status.st_mtime_ns))
    text = json.dumps(content | {"pictures": digest.hexdigest()}, default=str).encode()
    folders = cache_folders(folder)
    for path in (cache / name for cache in folders):
        if path.is_file() and read_file(path) == text:
            return path
    written = write_cache_file(folders, name, text)
    if written is None:
        raise InputError(
            f"{folder}: needed a writable cache folder for the cube faces, got none of {folders}; make one."
        )
    return written


def equirect_from_faces(faces: list[UInt8[Array, "size size 3"]], height: int) -> UInt8[Array, "height width 3"]:
    """The panorama at (height, 2 height): the mean of 2 x 2 bicubic samples a pixel, which continue across edges."""
    if height < _MIN_HEIGHT:
        return cv2.resize(equirect_from_faces(faces, _MIN_HEIGHT), (2 * height, height), interpolation=cv2.INTER_AREA)
    if len(faces[0]) > LARGEST_DENSITY * height:
        size = max(round(DENSITY * height), 1)
        faces = [cv2.resize(face, (size, size), interpolation=cv2.INTER_AREA) for face in faces]
    padded = _pad_faces(faces)
    rows = _SAMPLES * height
    latitude = (((np.arange(rows) + 0.5) / rows - 0.5) * np.pi).astype(np.float32)
    panorama = np.empty((height, 2 * height, 3), np.uint8)
    for side in range(4):
        # Columns of the side face, in whole pixels of the panorama; those of the back face lie at both ends.
        first, last = (math.floor((side + edge) * height / 2 + height + 0.5) for edge in (-0.5, 0.5))
        columns = np.arange(_SAMPLES * first, _SAMPLES * last)
        longitude = (((columns + 0.5) / rows - 1) * np.pi).astype(np.float32)
        block = _sample_columns(padded, side, longitude, latitude)
        panorama[:, np.arange(first, last) % (2 * height)] = cv2.resize(
            block, (last - first, height), interpolation=cv2.INTER_AREA
        )
    return panorama


def _sample_columns(
    padded: list[UInt8[Array, "side side 3"]],
    side: int,
    longitude: Float[Array, "column"],
    latitude: Float[Array, "row"],
) -> UInt8[Array, "row column 3"]:
    """Samples of columns that cross a side face and the upper and lower faces."""
    half = np.float32((len(padded[0]) - 2 * _FRAME) / 2)
    shift = half + np.float32(_FRAME - 0.5)

    def sample(face: int, x: Float[Array, "row column"], y: Float[Array, "row column"]) -> UInt8[Array, "row column 3"]:
        return cv2.remap(padded[face], x + shift, y + shift, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    block = np.empty((len(latitude), len(longitude), 3), np.uint8)
    for face, sign in ((4, -1), (5, 1)):
        rows = _slice(sign * latitude > _CAP)
        radius = half / np.tan(np.abs(latitude[rows]))[:, None]
        block[rows] = sample(face, radius * np.sin(longitude), -sign * radius * np.cos(longitude))
    relative = longitude - np.float32(side * math.pi / 2)
    middle = _slice(np.abs(latitude) < math.pi / 4)
    down = half * np.tan(latitude[middle])[:, None] / np.cos(relative)
    across = np.broadcast_to(half * np.tan(relative), down.shape)
    np.copyto(block[middle], sample(side, across, down), where=(np.abs(down) <= half)[..., None])
    return block


def _slice(chosen: Bool[Array, "row"]) -> slice:
    """The rows that are True, which follow each other."""
    rows = np.flatnonzero(chosen)
    return slice(rows[0], rows[-1] + 1) if len(rows) else slice(0)


def _pad_faces(faces: list[UInt8[Array, "size size 3"]]) -> list[UInt8[Array, "side side 3"]]:
    """The faces with a frame of `_FRAME` pixels, sampled from the faces around each."""
    size = len(faces[0])
    rotations = face_rotations().numpy()
    padded = []
    inside = slice(_FRAME, _FRAME + size)
    before, behind, whole = slice(0, _FRAME), slice(_FRAME + size, None), slice(None)
    position = (np.arange(-_FRAME, size + _FRAME) + 0.5) / size * 2 - 1
    for face, rotation in zip(faces, rotations, strict=True):
        result = cv2.copyMakeBorder(face, _FRAME, _FRAME, _FRAME, _FRAME, cv2.BORDER_REPLICATE)
        for rows, columns in ((before, inside), (behind, inside), (whole, before), (whole, behind)):
            y, x = np.meshgrid(position[rows], position[columns], indexing="ij")
            rays = np.stack((x, y, np.ones_like(x)), axis=-1) @ rotation.T
            other = int(face_of(torch.from_numpy(rays.mean(axis=(0, 1)))))
            local = rays @ rotations[other]
            u, v = (((local[..., n] / local[..., 2] + 1) * size / 2 - 0.5).astype(np.float32) for n in (0, 1))
            result[rows, columns] = cv2.remap(faces[other], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        padded.append(result)
    return padded
