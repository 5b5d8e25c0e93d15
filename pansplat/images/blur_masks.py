"""People, plates and other things that are hidden in photographs by masks that a user has drawn.

The mask of `STEM.jpg` is `STEM_blur.png` beside it, in any case, white where the photograph is hidden. Every read of
a panorama (`pansplat.images.image_files`) replaces these pixels first, so that nothing else contains them. They
become a blur of what is around them: no hidden pixel has an influence on it, so that nothing of it can be computed
back.
"""

from __future__ import annotations

import contextlib
import os
import re
import unicodedata
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from pansplat.errors import InputError
from pansplat.images.cube_images import BESIDE, CUBE_SUFFIX
from pansplat.images.rig_images import RIG_SUFFIX
from pansplat.system.strict_json import read_json

BLUR_SUFFIX, MASK_SUFFIX = "_blur", "_mask"  # ends of the stem of a mask's file name

_MASK_NAME = re.compile(r"(?:(.*)_)?(blur|mask)(?:\.\w+)*", re.IGNORECASE | re.DOTALL)
_listed: ContextVar[dict[tuple[Path, str], dict[str, list[Path]]] | None] = ContextVar("listed", default=None)
_MAX_ROWS = 256  # rows of the reduced picture in which the surroundings are blurred
_MARGIN_SHARE = 1 / 128  # growth of hidden regions, relative to the height; a JPEG mixes pixels within blocks of 16
_MIN_VISIBLE_SHARE = 0.25  # a cell of which less is visible takes its colour from its surroundings


def split_mask_name(path: Path) -> tuple[str, str] | None:
    """The stem of the picture of a mask and the suffix of its kind, by its name in any case; None for other files.

    The stem is empty for the mask of a whole folder, mask.png.
    """
    found = _MASK_NAME.fullmatch(path.name)
    return None if found is None else (found[1] or "", f"_{found[2].lower()}")


def fold_name(name: str) -> str:
    """A name as file systems compare it that do not distinguish capitals, and accents of one or two characters."""
    return unicodedata.normalize("NFC", name.casefold())


@contextlib.contextmanager
def list_folders_once() -> Iterator[None]:
    """List the masks of each folder at most once in the block, in which masks of many pictures are looked up."""
    token = _listed.set({})
    try:
        yield
    finally:
        _listed.reset(token)


def list_mask_files(folder: Path, kind: str) -> dict[str, list[Path]]:
    """The masks of a kind in a folder, by the folded stem of their picture; none if the folder cannot be listed."""
    listed = _listed.get()
    if listed is not None and (folder, kind) in listed:
        return listed[folder, kind]
    masks: dict[str, list[Path]] = {}
    for path in (folder / name for name in sorted(next(os.walk(folder), ("", [], []))[2]) if kind[1:] in name.lower()):
        found = split_mask_name(path)
        if found is not None and found[1] == kind and path.suffix.lower() == ".png" and path.is_file():
            masks.setdefault(fold_name(found[0]), []).append(path)
    if listed is not None:
        listed[folder, kind] = masks
    return masks


def find_mask_beside(picture: Path, kind: str) -> Path | None:
    """The mask of a kind beside a picture, which need not exist."""
    own = list_mask_files(picture.parent, kind).get(fold_name(picture.stem), [])
    if len(own) > 1:
        names = ", ".join(mask.name for mask in own)
        raise InputError(f"{picture}: needed one mask {kind}, got {names}; keep the right one.")
    return own[0] if own else None


def locate_panorama(image: Path) -> Path:
    """The path beside which the masks of a panorama are: its file, or where a file of its name would be."""
    for suffix in (CUBE_SUFFIX, RIG_SUFFIX):
        if image.name.endswith(suffix):
            folder = read_json(image, dict[str, Any]).get(BESIDE, image.parent)
            return Path(folder) / f"{image.name.removesuffix(suffix)}.png"
    return image


def find_blur_mask(image: Path) -> Path | None:
    """The file of the blur mask of a panorama; None if there is none."""
    return find_mask_beside(locate_panorama(image), BLUR_SUFFIX)


def resize_hidden(
    white: Bool[NDArray[Any], "rows columns"], height: int, width: int
) -> Bool[NDArray[Any], "height width"]:
    """A mask at another size: every pixel that a white pixel touches."""
    if white.shape == (height, width):
        return white
    method = cv2.INTER_AREA if white.shape[0] > height else cv2.INTER_LINEAR
    return cv2.resize(white.astype(np.float32), (width, height), interpolation=method) > 0


def widen_hidden(hidden: Bool[NDArray[Any], "height width"]) -> Bool[NDArray[Any], "height width"]:
    """What is hidden and a margin of 1.4 degrees around it: a photograph shows traces of a thing beside it."""
    margin = max(round(_MARGIN_SHARE * hidden.shape[0]), 1)
    padded = np.pad(hidden.astype(np.uint8), ((0, 0), (margin, margin)), mode="wrap")
    return cv2.dilate(padded, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))[:, margin:-margin] > 0


def blur_hidden(color: NDArray[Any], hidden: Bool[NDArray[Any], "height width"]) -> NDArray[Any]:
    """A panorama whose hidden pixels are a blur of the others, across the seam at +-180 degrees, too.

    Hidden colours have no influence. Surroundings are averaged in cells of a pyramid, from fine to coarse ("pull"), and
    interpolated back ("push"). Source: Gortler et al., The Lumigraph, SIGGRAPH 1996, section 3.4.

    Args:
        color: (height, width, 3), uint8 or float32.
        hidden: not all of the pixels.
    """
    if not hidden.any():
        return color
    result = color.copy()
    result[hidden] = 0
    height, width = hidden.shape
    rows = 1 << min(_MAX_ROWS.bit_length() - 1, height.bit_length() - 1)  # a power of two
    size = (2 * rows, rows)
    mean = cv2.resize(result, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    share = cv2.resize((~hidden).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    blurred = np.pad(_pull_and_push(mean, share), ((1, 1), (1, 1), (0, 0)), mode="edge")
    blurred[:, 0], blurred[:, -1] = blurred[:, -2].copy(), blurred[:, 1].copy()
    y, x = np.nonzero(hidden)
    places = (y + 0.5) * rows / height + 0.5, (x + 0.5) * 2 * rows / width + 0.5
    for channel in range(3):
        values = scipy.ndimage.map_coordinates(blurred[..., channel], places, order=1)
        result[y, x, channel] = np.rint(values) if color.dtype == np.uint8 else values
    return result


def fill_hidden(
    image: Float[Tensor, "3 height width"], shown: Bool[Tensor, "height width"]
) -> Float[Tensor, "3 height width"]:
    """A panorama for a file without alpha: what is hidden, and 3 pixels around that filters mix with it, is a blur."""
    hidden = cv2.dilate((~shown).numpy().astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    return torch.from_numpy(blur_hidden(image.permute(1, 2, 0).numpy(), hidden)).permute(2, 0, 1)


def _pull_and_push(
    sums: Float[NDArray[Any], "rows columns 3"], share: Float[NDArray[Any], "rows columns"]
) -> Float[NDArray[Any], "rows columns 3"]:
    """Colours of all cells from the sums of those of which a share is known."""
    is_known = share > _MIN_VISIBLE_SHARE
    known = np.where(is_known[..., None], sums / np.maximum(share, _MIN_VISIBLE_SHARE)[..., None], 0)
    if is_known.all():
        return known
    rows, columns = share.shape
    if rows == 1:
        return np.where(is_known[..., None], known, sums.sum(axis=(0, 1)) / max(float(share.sum()), 1e-6))
    coarse_sums = sums.reshape(rows // 2, 2, columns // 2, 2, 3).mean(axis=(1, 3))
    coarse_share = share.reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3))
    coarse = _pull_and_push(coarse_sums, coarse_share)
    wrapped = np.concatenate((coarse[:, -1:], coarse, coarse[:, :1]), axis=1)
    fine = cv2.resize(wrapped, (columns + 4, rows), interpolation=cv2.INTER_LINEAR)[:, 2:-2]
    return np.where(is_known[..., None], known, fine)
