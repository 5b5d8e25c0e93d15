"""Panoramas that are stored as perspective pictures from one place, and read as equirectangular ones.

As for cube faces (`pansplat.images.cube_images`), a small JSON file in a cache folder (suffix `RIG_SUFFIX`) stands for
the panorama, and the pictures are decoded when it is read.

Convention: OpenCV camera axes, pixel centres at half-integers.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from msgspec import Meta
from numpy import ndarray as Array

from pansplat.geometry.cubemap import face_rotations
from pansplat.geometry.equirect import pixel_directions
from pansplat.images.cube_images import DENSITY, LARGEST_DENSITY, Decode, equirect_from_faces, write_description

RIG_SUFFIX = ".rig.json"

_Row = tuple[float, float, float]
_SAMPLES = 2  # samples per pixel and axis
_CUBE_TOLERANCE = 1e-4  # deviation of a cube's faces: radians, and relative to half a face
_EDGE_MARGIN = 0.5  # pixels outside a picture that count as covered, because of rounding at common edges


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a pinhole camera of a rig.

    Attributes:
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels from the top left corner.
        width, height: pixels.
    """

    fx: Annotated[float, Meta(gt=0)]
    fy: Annotated[float, Meta(gt=0)]
    cx: float
    cy: float
    width: Annotated[int, Meta(gt=0)]
    height: Annotated[int, Meta(gt=0)]

    def scaled(self, width: int, height: int) -> Lens:
        """The camera of the picture at another size."""
        x, y = width / self.width, height / self.height
        return Lens(self.fx * x, self.fy * y, self.cx * x, self.cy * y, width, height)


@dataclass(frozen=True)
class RigView:
    """A picture of a rig, and where its camera looks.

    Attributes:
        file: the picture.
        rotation: from the axes of its camera to those of the panorama, by rows.
        lens: its camera; the file may have another size.
        mask: picture that is white where this one shows the scene; None for everywhere.
    """

    file: Path
    rotation: tuple[_Row, _Row, _Row]
    lens: Lens
    mask: Path | None = None


@dataclass(frozen=True)
class RigImage:
    """A panorama of perspective pictures."""

    views: Annotated[tuple[RigView, ...], Meta(min_length=1)]

    @property
    def height(self) -> int:
        """Height of the equirectangular panorama that has the detail of the sharpest picture's centre, pixels."""
        return max(2 * round(max(view.lens.fx, view.lens.fy) * math.pi / 2) for view in self.views)

    def list_files(self) -> Iterator[Path]:
        """All pictures and masks."""
        return (file for view in self.views for file in (view.file, view.mask) if file is not None)

    def measure_coverage(self) -> float:
        """Share of the sphere that the pictures show, in [0, 1]."""
        rays = pixel_directions(32, 64).numpy()
        weights = np.hypot(rays[..., 0], rays[..., 2])
        return float(weights[self._choose_views(rays) >= 0].sum() / weights.sum())

    def read(
        self, height: int, decode: Decode
    ) -> tuple[UInt8[Array, "height width 3"], Float[Array, "height width"] | None]:
        """The panorama at (height, 2 height), and the share of each pixel that the pictures show; None for all.

        A pixel is the mean of 2 x 2 bicubic samples of the picture whose edge is farthest away.
        """
        cube = self._find_cube()
        if cube is not None:
            return self._read_cube(cube, height, decode)
        pictures, lenses = [], []
        for view in self.views:
            pixels = _decode_view(view, decode)
            lens = view.lens.scaled(*pixels.shape[1::-1])
            ratio = max(lens.fx, lens.fy) * math.pi / height
            if ratio > LARGEST_DENSITY:
                size = [max(round(side * DENSITY / ratio), 1) for side in pixels.shape[1::-1]]
                pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
                lens = lens.scaled(*size)
            pictures.append(pixels)
            lenses.append(lens)
        chosen = self._choose_views(pixel_directions(height, 2 * height).numpy())
        color = np.zeros((height, 2 * height, 3), np.uint8)
        shown = np.zeros((height, 2 * height), np.float32)
        fine = pixel_directions(_SAMPLES * height, 2 * _SAMPLES * height)
        rays = fine.reshape(height, _SAMPLES, 2 * height, _SAMPLES, 3).permute(0, 2, 1, 3, 4).flatten(2, 3).numpy()
        for number, (view, picture, lens) in enumerate(zip(self.views, pictures, lenses, strict=True)):
            here = chosen == number
            if not here.any():
                continue
            local = rays[here] @ np.asarray(view.rotation, np.float32)
            x = lens.fx * local[..., 0] / local[..., 2] + lens.cx - 0.5
            y = lens.fy * local[..., 1] / local[..., 2] + lens.cy - 0.5
            found = _remap(picture, x.reshape(-1), y.reshape(-1)).reshape(*x.shape, -1).mean(axis=1)
            color[here] = np.rint(found[:, :3])
            shown[here] = (found[:, 3] >= 127.5) if found.shape[1] == 4 else 1
        return color, None if shown.all() else shown

    def _find_cube(self) -> list[tuple[RigView, int]] | None:
        """The pictures of the faces of a cube in the order of FACES, and their quarter turns; None for other rigs."""
        if len(self.views) != 6:
            return None
        faces = []
        for rotation in face_rotations().numpy():
            turned = [rotation.T @ np.asarray(view.rotation) for view in self.views]
            best = max(range(6), key=lambda number: turned[number][2, 2])
            lens, roll = self.views[best].lens, turned[best]
            half = np.array((lens.fx, lens.fy, lens.cx, lens.cy)) / (lens.width / 2)
            turns = round(math.atan2(roll[1, 0], roll[0, 0]) / (math.pi / 2))
            angle = turns * math.pi / 2
            upright = np.array(((math.cos(angle), -math.sin(angle)), (math.sin(angle), math.cos(angle))))
            errors = np.abs(half - 1).max(), np.abs(roll[:2, :2] - upright).max(), 1 - roll[2, 2]
            if lens.width != lens.height or max(errors) > _CUBE_TOLERANCE:
                return None
            faces.append((self.views[best], turns))
        return faces

    def _read_cube(
        self, cube: list[tuple[RigView, int]], height: int, decode: Decode
    ) -> tuple[UInt8[Array, "height width 3"], Float[Array, "height width"] | None]:
        """`read` of the faces of a cube, whose samples continue across the edges."""
        faces = [np.rot90(_decode_view(view, decode), -turns).copy() for view, turns in cube]
        size = len(faces[0])
        faces = [
            face if len(face) == size else cv2.resize(face, (size, size), interpolation=cv2.INTER_AREA)
            for face in faces
        ]
        color = equirect_from_faces([np.ascontiguousarray(face[..., :3]) for face in faces], height)
        if all(face.shape[2] == 3 for face in faces):
            return color, None
        masks = [
            np.repeat(face[..., 3:], 3, axis=2) if face.shape[2] == 4 else np.full_like(face, 255) for face in faces
        ]
        return color, (equirect_from_faces(masks, height)[..., 0] >= 128).astype(np.float32)

    def _choose_views(self, rays: Float[Array, "row column 3"]) -> Float[Array, "row column"]:
        """The picture whose edge is farthest from each direction; -1 where none shows it."""
        best = np.full(rays.shape[:2], -np.inf, np.float32)
        chosen = np.full(rays.shape[:2], -1)
        for number, view in enumerate(self.views):
            lens = view.lens
            local = rays @ np.asarray(view.rotation, np.float32)
            z = np.where(local[..., 2] > 1e-6, local[..., 2], np.nan)
            x, y = lens.fx * local[..., 0] / z + lens.cx, lens.fy * local[..., 1] / z + lens.cy
            with np.errstate(invalid="ignore"):
                margin = np.minimum(np.minimum(x, lens.width - x) / lens.fx, np.minimum(y, lens.height - y) / lens.fy)
                better: Bool[Array, "row column"] = (margin > best) & (margin > -_EDGE_MARGIN / max(lens.fx, lens.fy))
            best[better] = margin[better]
            chosen[better] = number
        return chosen


def _decode_view(view: RigView, decode: Decode) -> UInt8[Array, "rows columns channel"]:
    """The pixels of a picture, with its mask as a fourth channel."""
    pixels = decode(view.file)
    if view.mask is None:
        return pixels
    mask = cv2.resize(decode(view.mask), pixels.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return np.concatenate((pixels, mask[..., :1]), axis=2)


def _remap(
    picture: UInt8[Array, "rows columns channel"], x: Float[Array, "n"], y: Float[Array, "n"]
) -> Float[Array, "n channel"]:
    """Bicubic samples at pixel positions, of which there may be more than OpenCV's largest side."""
    width = 1 << 14
    count = -(-len(x) // width)
    padded = [np.pad(np.float32(values), (0, count * width - len(values))).reshape(count, width) for values in (x, y)]
    found = cv2.remap(picture, *padded, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return found.reshape(-1, picture.shape[2])[: len(x)].astype(np.float32)


def write_rig(rig: RigImage, folder: Path, name: str) -> Path:
    """Write the file that stands for a rig; see `pansplat.images.cube_images.write_description`."""
    views = (
        dataclasses.replace(view, file=view.file.absolute(), mask=view.mask and view.mask.resolve())
        for view in rig.views
    )
    return write_description(RigImage(tuple(views)), folder, name + RIG_SUFFIX)
