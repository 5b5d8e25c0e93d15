"""Writing a folder from which gsplat, nerfstudio and brush train: cube faces, a model of COLMAP, transforms.json."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray as Array
from torch import Tensor

from pansplat.geometry.cubemap import FACES, face_poses, face_rotations
from pansplat.geometry.equirect import pad_equirect, uv_from_directions
from pansplat.images.blur_masks import fill_hidden
from pansplat.images.image_files import read_height, read_panorama, write_image
from pansplat.images.rig_images import Lens
from pansplat.inputs.panorama_sets import Panorama, read_scene_mask
from pansplat.inputs.reconstructions.colmap import write_colmap
from pansplat.inputs.reconstructions.nerfstudio import write_nerfstudio
from pansplat.system.progress import report_progress, stage

POINTS = "points.ply"

_MAX_HEIGHT = 8192  # of a panorama, pixels
_MASK_HEIGHT = 512  # pixels
_LOSSLESS = (".png", ".exr", ".tif", ".tiff")  # pictures whose faces are PNG; those of others are JPG
_MARGIN = 2  # pixels, of the cubic filter
_BAND_ROWS = 256  # rows of a face that are sampled together


@stage()
def write_dataset(
    folder: Path,
    views: Sequence[Panorama],
    siblings: tuple[Path, ...],
    points: Float[Array, "point 3"],
    colors: UInt8[Array, "point 3"],
) -> int:
    """Write cube faces with poses, and points: images/, masks/ (if some are not white), sparse/0/, transforms.json.

    The pictures are made anew, one at a time, and carry no metadata of the photographs. transforms.json names
    `POINTS`, which the caller writes, in the world of `pansplat.inputs.reconstructions.nerfstudio.Z_UP`.

    Args:
        folder: an empty one.
        views: the panoramas, in a world of metres with y down.
        siblings: panoramas in which static content is detected, see `pansplat.inputs.panorama_sets.PanoramaSet`.
        points, colors: positions, metres, and 8-bit sRGB.

    Returns:
        The number of pictures.
    """
    sparse = folder / "sparse" / "0"
    for sub in (folder / "images", sparse):
        sub.mkdir(parents=True)
    masks = [
        read_panorama(view.image, _MASK_HEIGHT)[1] & read_scene_mask(view, siblings, _MASK_HEIGHT) for view in views
    ]
    has_masks = not all(bool(mask.all()) for mask in masks)
    if has_masks:
        (folder / "masks").mkdir()
    rigs, shots = [], []
    for number, (view, mask) in enumerate(zip(views, masks, strict=True)):
        report_progress("writing cube faces", number / len(views))
        height = min(read_height(view.image), _MAX_HEIGHT)
        size = 2 * math.ceil(height / math.pi)
        lens = Lens(size / 2, size / 2, size / 2, size / 2, size, size)
        faces = cut_faces(fill_hidden(*read_panorama(view.image, height)), size)
        shown = cut_faces(mask.float().expand(3, -1, -1), size)
        plain = re.sub(r"[^\w.-]+", "_", view.name)  # COLMAP reads no spaces
        stem = f"{number:04d}_{plain}"
        suffix = ".png" if view.image.suffix.lower() in _LOSSLESS else ".jpg"
        rig = []
        for face, pose in enumerate(face_poses(view.cam2world.double())):
            name = f"{stem}_{FACES[face]}{suffix}"
            write_image(folder / "images" / name, next(faces), panorama=False)
            if has_masks:
                white = np.where(next(shown) >= 0.5, np.uint8(255), np.uint8(0))
                write_image(folder / "masks" / f"{name}.png", white, panorama=False)
            rig.append((name, pose, lens))
            shots.append((f"images/{name}", pose, lens, f"masks/{name}.png" if has_masks else None))
        rigs.append(rig)
    write_colmap(sparse, rigs, points, colors)
    write_nerfstudio(folder / "transforms.json", shots, POINTS if len(points) else None)
    (folder / "scale.txt").write_text("1\n", "utf-8")  # metres per unit
    return len(shots)


def cut_faces(image: Float[Tensor, "3 height width"], size: int) -> Iterator[Float[Array, "size size 3"]]:
    """Yield the six cube faces of a panorama, by bicubic samples, in [0, 1]."""
    height, width = image.shape[1:]
    padded = np.empty((height + 2 * _MARGIN, width + 2 * _MARGIN, 3), np.float32)
    for channel in range(3):
        padded[..., channel] = pad_equirect(image[channel : channel + 1], _MARGIN)[0]
    del image  # gigabytes
    position = (torch.arange(size, dtype=torch.float64) + 0.5) / size * 2 - 1
    for rotation in face_rotations():
        face = np.empty((size, size, 3), np.float32)
        for first in range(0, size, _BAND_ROWS):
            y, x = torch.meshgrid(position[first : first + _BAND_ROWS], position, indexing="ij")
            uv = uv_from_directions(torch.stack((x, y, torch.ones_like(x)), dim=-1) @ rotation.T).numpy()
            columns, rows = (
                (uv[..., axis] * count - 0.5 + _MARGIN).astype(np.float32) for axis, count in ((0, width), (1, height))
            )
            band = cv2.remap(padded, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
            face[first : first + _BAND_ROWS] = band.clip(0, 1)
        yield face
