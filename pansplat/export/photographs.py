"""Photographs in pages and films, which show them where a camera stands at a panorama; for pages cube tiles of two or
three sizes.

What masks hide is replaced before anything is encoded: blur masks by the reading of every panorama, scene masks by what
the Gaussians show there. The tiles are encoded from pixels, so that no metadata of a file is in them.
"""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import json
import math
import re
import unicodedata
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from PIL import Image
from torch import Tensor
from torch.nn import functional

from pansplat import pipeline
from pansplat.export.page_data import PagePhotograph
from pansplat.export.training_set import cut_faces
from pansplat.gaussians.scene import Scene
from pansplat.images.cube_images import DENSE_FACE
from pansplat.images.image_files import read_face_size
from pansplat.inputs.content import hash_pixels
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.system.files import SOFTWARE, make_unique_name
from pansplat.system.progress import report_progress
from pansplat.system.source_hash import hash_sources
from pansplat.system.store import Store, hash_parts
from pansplat.tours.graph import TourGraph
from pansplat.tours.merge import select_views
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.scene_views import choose_scene_views

MIN_HEIGHT = 1024  # least rows of a photograph in a page, unless the file has fewer
MAX_HEIGHT = 4096  # most rows of a photograph in a folder
_STEP = 16  # the size of a face is a multiple of it, pixels
_LABEL = 40  # letters of the name of a panorama in names of files
_PREVIEW, _MIDDLE = 384, 1344  # sizes of the faces of smaller levels, pixels
_TILE = 1344  # largest size of a tile, pixels; a photograph of 4,096 rows has 36
# Qualities of JPEG, which keeps the grain of walls; WebP of the same size has 1 dB more and loses up to a fifth of the
# gradient.
_QUALITY, _FOLDER_QUALITY, _PREVIEW_QUALITY, _LOWER_QUALITIES = 82, 90, 75, (75, 65)
_SHRINK = 0.95  # largest factor between a height that is too large for the page and the next one
_HIDDEN_ROWS = 512  # rows of the image of the Gaussians that is shown in what masks hide
_GUARD = 3  # pixels around what is hidden that are not shown
_FEATHER = 1 / 128  # width of the margin around them that fades, over the height of the photograph


@dataclass(frozen=True, eq=False)
class PackedPhotograph:
    """A photograph as files of JPEG.

    Attributes:
        label: begins the names of the files.
        height: of the panorama that it was made from, pixels.
        levels: size of a face and of a tile of each level, the smallest first, pixels.
        tiles: of each level and face, row by row.
        rotation: from the axes of the panorama to the world.
    """

    label: str
    height: int
    levels: tuple[tuple[int, int], ...]
    tiles: tuple[bytes, ...]
    rotation: Float[np.ndarray, "3 3"]

    @cached_property
    def name(self) -> str:
        """The label, and hexadecimal digits that change with the content."""
        return f"{self.label}_{hashlib.blake2b(b''.join(self.tiles), digest_size=8).hexdigest()}"

    @property
    def num_bytes(self) -> int:
        """The bytes of all tiles."""
        return sum(map(len, self.tiles))

    def describe(self) -> PagePhotograph:
        """The description of the photograph that photographs.js reads."""
        return PagePhotograph(self.name, self.levels, tuple(map(tuple, self.rotation.tolist())))

    def make_elements(self) -> list[str]:
        """The elements of a page in one file that hold the tiles of the smallest level, and all others."""
        texts = [base64.b64encode(tile).decode() for tile in self.tiles]
        (size, tile), *_ = self.levels
        few = 6 * (-(-size // tile)) ** 2
        return [
            f'<script type="text/plain">{" ".join(chosen)}</script><script>addTile("{self.name}", {first})</script>'
            for first, chosen in ((0, texts[:few]), (few, texts[few:]))
            if chosen
        ]

    def make_files(self) -> dict[str, bytes]:
        """The tiles by their file names."""
        return {f"{self.name}_{n}.jpg": tile for n, tile in enumerate(self.tiles)}


def label_files(names: Sequence[str]) -> list[str]:
    """The names of panoramas as parts of names of files and of addresses; different ones."""
    labels: list[str] = []
    for name in names:
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
        label = re.sub("[^a-z0-9]+", "-", plain)[:_LABEL].strip("-")
        labels.append(make_unique_name(label or "panorama", labels))
    return labels


def list_photographs(source: PanoramaSet | TourGraph, views: Sequence[int]) -> list[PanoramaSet]:
    """A pair of one panorama for each of some views of a scene that was predicted from a pair or tour."""
    if isinstance(source, TourGraph):
        return [source.make_set([view]) for view in views]
    return [dataclasses.replace(source, context=(source.context[view],)) for view in views]


def pack_photographs(
    scene: Scene, photographs: Sequence[PanoramaSet], num_bytes: float, height: int | None
) -> list[PackedPhotograph]:
    """The photographs of a scene's views, within a number of bytes if that is possible.

    They keep their height if they fit. Else the height falls to `MIN_HEIGHT`, then the quality.

    Args:
        photographs: of each view, see `list_photographs`.
        height: largest height, pixels, whatever their size; by default what fits.
    """
    rows = min(height or MAX_HEIGHT, max(photograph.image_height for photograph in photographs))
    sizes = [read_face_size(photograph.context[0].image) for photograph in photographs]
    labels = label_files(scene.names)
    qualities = [_QUALITY, *_LOWER_QUALITIES] if num_bytes < math.inf else [_FOLDER_QUALITY]
    while True:
        packed: list[PackedPhotograph] = []
        can_shrink, expected = height is None and rows > MIN_HEIGHT, 0.0
        for view, photograph in enumerate(photographs):
            report_progress("packing photographs", view / len(photographs))
            rotation = scene.cam2world[view, :3, :3].double().numpy()
            tiles = _open_tiles(scene, view, photograph, rows, sizes[view], qualities[0])
            packed.append(PackedPhotograph(labels[view], *tiles, rotation))
            expected = sum(each.num_bytes for each in packed) * len(photographs) / len(packed)
            limit = (1.5 if len(packed) < len(photographs) else 1) * num_bytes
            if expected > limit and (can_shrink or (height is None and len(qualities) > 1)):
                break
        else:
            return packed
        if can_shrink:  # bytes grow by less than the number of pixels
            shown = min(rows, round(max(sizes) / DENSE_FACE))
            rows = max(round(shown * min(math.sqrt(num_bytes / expected), _SHRINK)), MIN_HEIGHT)
        else:
            qualities.pop(0)


def _open_tiles(
    scene: Scene, view: int, photograph: PanoramaSet, rows: int, most: int, quality: int
) -> tuple[int, tuple[tuple[int, int], ...], tuple[bytes, ...]]:
    """Height, levels and tiles of a photograph of at most some rows, and of faces of at most a size.

    They are stored by the content of the photograph, unless Gaussians are shown in what masks hide.
    """
    gains = scene.gains[view] if scene.joint and scene.gains else ()
    pixels, options = hash_pixels(photograph.context, photograph.siblings), json.dumps([rows, most, quality, gains])
    store, key = Store(photograph.folder), hash_parts(hash_sources(__name__), pixels, options)
    if (found := store.read("tiles", key)) is not None:
        return found[0], found[1], tuple(tile.tobytes() for tile in found[2])
    image, shown = load_photograph(photograph, rows)
    image = _cover_hidden(scene, view, image, shown)
    levels, tiles = _pack(image, min(DENSE_FACE * image.shape[1], most), quality)
    if shown.min() >= 1:
        store.write("tiles", key, (image.shape[1], levels, [np.frombuffer(tile, np.uint8) for tile in tiles]))
    return image.shape[1], levels, tiles


def read_photograph(scene: Scene, view: int, photograph: PanoramaSet, height: int) -> Float[Tensor, "3 height width"]:
    """A photograph of at most a height, with the exposure of the Gaussians, and without what its masks hide."""
    return _cover_hidden(scene, view, *load_photograph(photograph, height))


@torch.no_grad()
def _cover_hidden(
    scene: Scene, view: int, image: Float[Tensor, "3 height width"], shown: Float[Tensor, "height width"]
) -> Float[Tensor, "3 height width"]:
    """The picture of `load_photograph` with the exposure of the Gaussians, and these in what masks hide."""
    if scene.joint and scene.gains:  # the Gaussians of single views have the exposure of their photographs
        image = image / torch.tensor(scene.gains[view]).to(image)[:, None, None]
    if shown.min() >= 1:
        return image.clamp(0, 1)
    rows = min(scene.height, _HIDDEN_ROWS)
    drawn = pipeline.render(_select_shown(scene, view), scene.cam2world[view], size=(rows, 2 * rows)).color.clamp(0, 1)
    drawn = functional.interpolate(drawn[None].to(image), image.shape[1:], mode="bilinear")[0]
    return torch.where(shown > 0, torch.lerp(drawn, image.clamp(0, 1), shown), drawn)


def load_photograph(
    photograph: PanoramaSet, height: int
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"]]:
    """The picture of a pair of one panorama, of at most a height, and where it may be shown: 0 in what masks hide."""
    views = photograph.load_context(max(min(height, photograph.image_height), 2))  # faces need two rows
    image, mask = views.images[0], views.shown[0]
    shown = torch.ones(1).expand(mask.shape) if mask.all() else torch.from_numpy(_fade_from_hidden(mask.numpy()))
    return image, shown


def _select_shown(scene: Scene, view: int) -> Scene:
    """What a page draws at a panorama."""
    if scene.tour is None:
        return scene
    tour = make_graph(scene)
    edge, _ = tour.find_nearest_edge(scene.cam2world[view, :3, 3].numpy())
    return select_views(scene, choose_scene_views(tour)[edge])


def _fade_from_hidden(mask: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Weights of a photograph: 0 where it is hidden and next to it, from where it fades in."""
    feather = max(round(_FEATHER * len(mask)), 1)
    margin = min(feather + _GUARD, mask.shape[1])
    padded = np.pad(mask.astype(np.uint8), ((0, 0), (margin, margin)), mode="wrap")
    distances = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[:, margin:-margin]
    return ((distances - _GUARD) / feather).clip(0, 1).astype(np.float32)


def _pack(
    image: Float[Tensor, "3 height width"], most: float, quality: int
) -> tuple[tuple[tuple[int, int], ...], tuple[bytes, ...]]:
    """The levels and the tiles of all of them; the largest one has faces of at most a size."""
    size = max(int(most / _STEP) * _STEP, _STEP)
    sizes = [smaller for smaller in (_PREVIEW, _MIDDLE) if 1.3 * smaller < size]
    levels = tuple((each, -(-each // -(-each // _TILE))) for each in (*sizes, size))

    def encode_face(pixels: UInt8[np.ndarray, "size size 3"]) -> list[list[bytes]]:
        tiles = []
        for level, (smaller, tile) in enumerate(levels):
            reduced = cv2.resize(pixels, (smaller, smaller), interpolation=cv2.INTER_AREA)
            is_preview = level == 0 < len(levels) - 1
            tiles.append(_encode(reduced, tile, _PREVIEW_QUALITY if is_preview else quality))
        return tiles

    with ThreadPoolExecutor() as threads:
        faces = list(threads.map(encode_face, ((255 * face + 0.5).astype(np.uint8) for face in cut_faces(image, size))))
    return levels, tuple(tile for level in zip(*faces, strict=True) for face in level for tile in face)


def _encode(pixels: UInt8[np.ndarray, "size size 3"], tile: int, quality: int) -> list[bytes]:
    """The tiles of a face."""
    encoded = []
    for top in range(0, len(pixels), tile):
        for left in range(0, len(pixels), tile):
            with io.BytesIO() as file:
                part = np.ascontiguousarray(pixels[top : top + tile, left : left + tile])
                Image.fromarray(part).save(file, "JPEG", quality=quality, optimize=True, comment=SOFTWARE.encode())
                encoded.append(file.getvalue())
    return encoded
