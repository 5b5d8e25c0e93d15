"""Detection of pixels that do not show the scene: holes of scans, and what is fixed to the camera (tripod, black
caps, car roof).

Between panoramas taken at different places everything moves in camera axes, except what is fixed to the camera. Around
each pole, a closed outline is searched whose edges have the same sign in nearly all panoramas, while the surroundings
move by parallax. Floors and ceilings have no such outline. Thin parts that are connected to the region (legs, rods) are
added if their own edges do not move either.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from pansplat.errors import InputError
from pansplat.images.image_files import list_masks, read_thumbnail

Array = NDArray[Any]

_HEIGHT = 256  # rows of the panoramas for detection
_MAX_IMAGES = 16  # evenly spaced panoramas of a long sequence that are compared
_MIN_DIFFERENCE = 0.02  # mean grey difference; two panoramas with less count as taken at one place

_SAMPLE_DEGREES = 0.5  # degrees between samples of the polar maps
_MAP_RADIUS = 50.0  # degrees; radius of the polar maps
_RINGS, _SECTORS = int(_MAP_RADIUS / _SAMPLE_DEGREES), 180  # samples of the polar maps: from the pole, and around it
_MIN_RADIUS, _MAX_RADIUS = 4.0, 45.0  # degrees from the pole to the outline
_MAX_BEND = 2  # largest change of the outline's ring between neighbouring sectors
_EDGE_QUANTILE = 0.2  # quantile over the panoramas: four of five must have an edge
_MIN_EDGE = 0.02  # grey contrast over a degree
_MIN_COVERAGE = 0.85  # least fraction of the outline with the contrast _MIN_EDGE
_MAX_SHIFT = 5  # samples between views of a static outline, because panoramas are levelled after capture
_OUTLINE_BAND = 5  # samples on both sides of the outline that are compared
_SURROUNDINGS = 10, 30  # samples from the outline to the inner and outer edge of the surroundings
_MIN_CORRELATION = 0.5  # least correlation of a static outline between two views
_MAX_AROUND = 0.6  # largest correlation of an outline's surroundings, relative to the outline's
_MIN_PAIRS = 0.6  # fraction of the pairs of views that must agree; one view with glare spoils two pairs of five
_MIN_VIEWS_FOR_LEGS = 4  # with fewer panoramas too many edges are static by chance
_LEG_RADIUS, _LEG_SHIFT, _LEG_GAP = 5, 5, 7  # samples: half thickness, shift between views, largest interruption
_LEG_CONTRAST = 0.045  # least grey difference of a leg to the floor
_REGION_MARGIN = 3  # samples added around the region, because its edge is blurred


def detect_scene_mask(images: Float[Tensor, "view 3 height width"]) -> Bool[Tensor, "height width"]:
    """A mask of the scene: False in regions around the poles that are static in all panoramas.

    Panoramas that hardly differ from an earlier one are ignored, because everything is static for a camera that did not
    move. Nothing is masked when fewer than two panoramas remain.
    """
    height, width = images.shape[-2:]
    size = (2 * _HEIGHT, _HEIGHT)
    grey = images.float().mean(dim=1).cpu().numpy()
    grey = _drop_similar(np.stack([cv2.resize(g, size, interpolation=cv2.INTER_AREA) for g in grey]))
    if len(grey) < 2:
        return torch.ones(height, width, dtype=torch.bool)
    zenith = _static_cap(grey)
    nadir = _static_cap(np.ascontiguousarray(grey[:, ::-1]))[::-1]
    static = np.maximum(zenith, nadir).astype(np.float32)
    return torch.from_numpy(cv2.resize(static, (width, height), interpolation=cv2.INTER_LINEAR) < 0.5)


def find_holes(image: Float[Tensor, "3 height width"], *, is_scan: bool = False) -> Bool[Tensor, "height width"]:
    """True in patches of exact black, and where resizing mixed their edges with the scene.

    In the rendering of a scan they are holes; in a photograph only those that reach a pole are, because others are
    black surfaces, such as screens and windows at night.
    """
    black = (image.detach().cpu().numpy().max(axis=0) <= 0).astype(np.uint8)
    patches = cv2.morphologyEx(black, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if not is_scan and patches.any():  # labels take four bytes a pixel
        labels = cv2.connectedComponents(patches)[1]
        patches *= np.isin(labels, labels[[0, -1]])
    return torch.from_numpy(cv2.dilate(patches, np.ones((5, 5), np.uint8)) > 0)


def scene_mask_of_files(paths: tuple[Path, ...], height: int) -> Bool[Tensor, "height width"]:
    """`detect_scene_mask` of panorama files, at (height, 2 height). Unreadable files are ignored.

    Results are cached in memory.
    """
    stamped = tuple((path, _stamp(path), tuple(map(_stamp, list_masks(path)))) for path in sample_files(paths))
    scene = _cached_mask(stamped)
    if scene.all():
        return torch.ones(height, 2 * height, dtype=torch.bool)
    resized = cv2.resize(scene.astype(np.float32), (2 * height, height), interpolation=cv2.INTER_LINEAR)
    return torch.from_numpy(resized >= 0.5)


def sample_files(paths: tuple[Path, ...]) -> list[Path]:
    """Those of panorama files in which static content is detected."""
    if len(paths) > _MAX_IMAGES:
        paths = tuple(paths[i] for i in np.linspace(0, len(paths) - 1, _MAX_IMAGES).round().astype(int))
    return [path for path in paths if path.is_file()]


def _stamp(path: Path) -> tuple[int, int]:
    return path.stat().st_mtime_ns, path.stat().st_size


@lru_cache(maxsize=32)
def _cached_mask(stamped: tuple[tuple[Path, Any, Any], ...]) -> NDArray[np.bool_]:
    images = []
    for path, *_ in stamped:
        try:
            images.append(read_thumbnail(path, _HEIGHT))
        except InputError:  # the error is raised again when the panorama is loaded
            continue
    if len(images) < 2:
        return np.ones((_HEIGHT, 2 * _HEIGHT), dtype=bool)
    return detect_scene_mask(torch.stack(images)).numpy()


def _drop_similar(grey: Array) -> Array:
    kept: list[int] = []
    for i in range(len(grey)):
        if all(np.abs(grey[i] - grey[j]).mean() > _MIN_DIFFERENCE for j in kept):
            kept.append(i)
    return grey[kept]


def _static_cap(grey: Array) -> NDArray[np.bool_]:
    """The static region around the upper pole of panoramas (view height width), as a mask of their pixels."""
    none = np.zeros(grey.shape[1:], dtype=bool)
    edges = _common_edges(_ring_edges(grey))
    outline = _closed_outline(edges)
    if (edges[outline, np.arange(_SECTORS)] > _MIN_EDGE).mean() < _MIN_COVERAGE:
        return none
    discs = np.stack([_disc(g) for g in grey])
    inside = _inside(outline)
    if not _is_static(discs, inside):
        return none
    region = cv2.dilate(inside, _ellipse(1))
    if len(discs) >= _MIN_VIEWS_FOR_LEGS:
        region = _add_legs(discs, region)
    return _cap_from_disc(cv2.dilate(region, _ellipse(_REGION_MARGIN)), grey.shape[1])


def _sample(grey: Array, colatitude: Array, azimuth: Array) -> Array:
    """Bilinear samples of a panorama; `colatitude` is from the upper pole, `azimuth` from the left edge, degrees."""
    height = grey.shape[0]
    blurred = cv2.GaussianBlur(grey, (0, 0), 0.7)
    padded = cv2.copyMakeBorder(blurred, 0, 0, 2, 2, cv2.BORDER_WRAP)
    x = azimuth / 180 * height - 0.5 + 2
    y = colatitude / 180 * height - 0.5
    return cv2.remap(
        padded, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def _ring_edges(grey: Array) -> Array:
    """Outward grey differences over two degrees (view ring sector)."""
    rings, sectors = (np.arange(_RINGS) + 0.5) * _SAMPLE_DEGREES, (np.arange(_SECTORS) + 0.5) * 360 / _SECTORS
    azimuth, colatitude = np.meshgrid(sectors, rings)
    kernel = np.array([[-0.5], [-0.5], [0], [0.5], [0.5]], dtype=np.float32)
    maps = [_sample(g, colatitude, azimuth) for g in grey]
    return np.stack([cv2.filter2D(m, -1, kernel, borderType=cv2.BORDER_REPLICATE) for m in maps])


def _common_edges(signed: Array) -> Array:
    """Magnitude of the edges that most views (axis 0) have with the same sign, else 0."""
    low, high = np.quantile(signed, (_EDGE_QUANTILE, 1 - _EDGE_QUANTILE), axis=0)
    return np.maximum(np.maximum(low, 0), np.maximum(-high, 0)).astype(np.float32)


def _closed_outline(edges: Array) -> NDArray[np.intp]:
    """Ring of the strongest closed curve around the pole in each sector, by dynamic programming.

    Two turns are optimised and the middle one is kept, so that the curve closes.
    """
    rings, sectors = edges.shape
    gain = np.minimum(edges, 3 * _MIN_EDGE)  # the limit keeps a few strong edges from compensating for gaps
    gain[: int(_MIN_RADIUS / _SAMPLE_DEGREES)] = -1
    gain[int(_MAX_RADIUS / _SAMPLE_DEGREES) :] = -1
    score = np.zeros(rings)
    came_from = np.empty((2 * sectors, rings), dtype=np.intp)
    steps = np.arange(-_MAX_BEND, _MAX_BEND + 1)
    source = np.clip(np.arange(rings)[None] + steps[:, None], 0, rings - 1)
    for turn in range(2 * sectors):
        candidates = score[source] - 0.1 * _MIN_EDGE * np.abs(steps)[:, None]
        best = candidates.argmax(axis=0)
        came_from[turn] = source[best, np.arange(rings)]
        score = candidates[best, np.arange(rings)] + gain[:, turn % sectors]
    outline = np.empty(2 * sectors, dtype=np.intp)
    ring = int(score.argmax())
    for turn in range(2 * sectors - 1, -1, -1):
        outline[turn] = ring
        ring = came_from[turn, ring]
    half = sectors // 2
    return np.roll(outline[half : half + sectors], half)


def _disc_coordinates() -> tuple[Array, Array]:
    """Radius and azimuth of the samples of a flat map around the pole, degrees."""
    axis = ((np.arange(2 * _RINGS) + 0.5) * _SAMPLE_DEGREES - _MAP_RADIUS).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    return np.hypot(x, y), np.degrees(np.arctan2(y, x)) % 360


def _disc(grey: Array) -> Array:
    """Flat (azimuthal equidistant) map of a panorama around its upper pole."""
    return _sample(grey, *_disc_coordinates())


def _inside(outline: NDArray[np.intp]) -> NDArray[Any]:
    """A mask of the disc samples within the outline."""
    radius, azimuth = _disc_coordinates()
    sector = (azimuth / 360 * _SECTORS).astype(int) % _SECTORS
    return (radius <= (outline[sector] + 0.5) * _SAMPLE_DEGREES).astype(np.uint8)


def _ellipse(samples: int) -> NDArray[Any]:
    """Structuring element of that radius."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * samples + 1, 2 * samples + 1))


def _gradients(disc: Array) -> Array:
    """Grey differences over a degree (2 y x)."""
    return np.stack([cv2.Scharr(disc, -1, dx, dy) / 16 for dx, dy in ((1, 0), (0, 1))])


def _is_static(discs: Array, inside: NDArray[Any]) -> bool:
    """Whether the edges of the outline are static and those of its surroundings move, in most pairs of views.

    False where little moves at all, such as a high ceiling with a short baseline.
    """
    near = _disc_coordinates()[0] < _MAP_RADIUS
    outline = (cv2.dilate(inside, _ellipse(_OUTLINE_BAND)) > cv2.erode(inside, _ellipse(_OUTLINE_BAND))) & near
    around = (cv2.dilate(inside, _ellipse(_SURROUNDINGS[1])) > cv2.dilate(inside, _ellipse(_SURROUNDINGS[0]))) & near
    views = range(len(discs))
    pairs = list(itertools.combinations(views, 2)) if len(discs) <= 5 else list(itertools.pairwise(views))
    gradients = [np.clip(_gradients(disc), -0.1, 0.1) for disc in discs]
    static = []
    for i, j in pairs:
        fit = _best_fit(gradients[i], gradients[j], outline)
        static.append(fit > _MIN_CORRELATION and _best_fit(gradients[i], gradients[j], around) < _MAX_AROUND * fit)
    return float(np.mean(static)) >= _MIN_PAIRS


def _best_fit(first: Array, second: Array, where: NDArray[np.bool_]) -> float:
    """Largest correlation of the edges of two views over small shifts, in [-1, 1]."""
    y, x = np.nonzero(where)
    fixed = first[:, y, x]
    limit = first.shape[-1] - 1
    best = -1.0
    for dy in range(-_MAX_SHIFT, _MAX_SHIFT + 1):
        for dx in range(-_MAX_SHIFT, _MAX_SHIFT + 1):
            moved = second[:, np.clip(y + dy, 0, limit), np.clip(x + dx, 0, limit)]
            norm = float(np.sqrt((fixed * fixed).sum() * (moved * moved).sum()))
            best = max(best, float((fixed * moved).sum()) / norm if norm > 0 else 0.0)
    return best


def _add_legs(discs: Array, region: NDArray[Any]) -> NDArray[Any]:
    """The region with the connected thin parts that nearly all views have at about the same place."""
    parts = np.zeros_like(region)
    for operation in (cv2.MORPH_BLACKHAT, cv2.MORPH_TOPHAT):
        thin = [cv2.morphologyEx(disc, operation, _ellipse(_LEG_RADIUS)) for disc in discs]
        # Dilated by the largest shift between views, so that shifted parts overlap.
        common = np.quantile([cv2.dilate(t, _ellipse(_LEG_SHIFT)) for t in thin], _EDGE_QUANTILE, axis=0)
        parts |= (common > _LEG_CONTRAST).astype(np.uint8)
    joined = cv2.morphologyEx(region | parts, cv2.MORPH_CLOSE, _ellipse(_LEG_GAP))
    _, labels = cv2.connectedComponents(joined, connectivity=8)
    found = (labels == labels[_RINGS, _RINGS]) & (labels > 0) & (_disc_coordinates()[0] < _MAP_RADIUS)
    return found.astype(np.uint8) | region


def _cap_from_disc(disc: NDArray[Any], height: int) -> NDArray[np.bool_]:
    """A disc map as a mask of a panorama (height, 2 height); False outside the disc."""
    colatitude = (np.arange(height) + 0.5) * 180 / height
    azimuth = np.radians((np.arange(2 * height) + 0.5) * 180 / height)
    x = (colatitude[:, None] * np.cos(azimuth) + _MAP_RADIUS) / _SAMPLE_DEGREES - 0.5
    y = (colatitude[:, None] * np.sin(azimuth) + _MAP_RADIUS) / _SAMPLE_DEGREES - 0.5
    return cv2.remap(disc, x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST) > 0
