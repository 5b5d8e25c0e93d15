"""Hashes of what panoramas show and state, by which results that depend on them are recognised."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import PIL
from torch import Tensor

from pansplat.images.image_files import list_masks
from pansplat.images.masks import sample_files
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.system.source_hash import hash_sources
from pansplat.system.store import hash_file, hash_parts


def hash_image(image: Path) -> str:
    """A hash of the bytes of a panorama and of its masks.

    The file that stands for cube faces or perspective pictures changes with the size and time of each.
    """
    return hash_parts(*map(hash_file, (image, *list_masks(image))))


def hash_pixels(panoramas: Iterable[Panorama], siblings: tuple[Path, ...]) -> str:
    """A hash of all that decides which pixels are read of panoramas, and which of them show the scene."""
    views, others = tuple(panoramas), []
    if any(view.mask is None for view in views):  # what moves with the camera is found by comparison with the siblings
        others = [hash_image(image) for image in sample_files(siblings)]
    stated = [(hash_image(view.image), view.mask and hash_file(view.mask), view.is_scan) for view in views]
    return hash_parts(_hash_code(), json.dumps([stated, others]))


def hash_context(pair: PanoramaSet) -> str:
    """A hash of all that `PanoramaSet.load_context` depends on, besides the height."""
    poses = [view.cam2world.tolist() for view in pair.context]
    return hash_parts(hash_pixels(pair.context, pair.siblings), json.dumps([poses, pair.near, pair.far]))


def hash_panorama(panorama: Panorama) -> str:
    """A hash of all that a panorama shows and states: its files, pose, title, links, notes and start view."""

    def describe(value: Any) -> Any:
        if isinstance(value, Path):
            return hash_file(value)
        return value.tolist() if isinstance(value, Tensor) else vars(value)

    placement = panorama.placement.state, panorama.placement.about
    shown = {"image": hash_image(panorama.image), "placement": placement, "links_at": None}
    return hash_parts(json.dumps(vars(panorama) | shown, default=describe))


@cache
def _hash_code() -> str:
    """A hash of the code that reads panoramas."""
    return hash_parts(hash_sources("pansplat.inputs.panorama_sets"), PIL.__version__, cv2.__version__)
