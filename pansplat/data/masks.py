"""What travels with the camera: tripod, caps, car roof. Found as the region round a pole that stays in place.

In camera axes everything moves between panoramas taken at different places, except what is fixed to the
camera. Round each pole we look for a closed outline whose edge is there, with the same sign, in (nearly) all
panoramas, while its surroundings move by parallax. Floors and ceilings, however alike they look, have no such
outline. What sticks out of it (legs, rods) is added where its own edges stay as well.
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

from pansplat.data.images import read_thumbnail
from pansplat.errors import InputError

Array = NDArray[Any]

_HEIGHT = 256  # pixels; masks are found at this size
_MOST_IMAGES = 16  # of a long sequence, evenly spread
_MOVED = 0.02  # mean grey difference, below which two panoramas count as taken from one place

_STEP = 0.5  # degrees between samples of the maps round a pole
_REACH = 50.0  # degrees from a pole that are looked at
_RINGS, _SECTORS = int(_REACH / _STEP), 180
_SMALLEST, _LARGEST = 4.0, 45.0  # degrees from the pole to the outline
_BEND = 2  # rings that the outline may move by from one sector to the next
_AGREEMENT = 0.2  # quantile over the panoramas: four in five must have the edge
_EDGE, _AROUND = (
    0.02,
    0.85,
)  # grey contrast over a degree that counts, and the part of the outline that must have it
_SHIFT = 5  # samples that a static outline may be off by: panoramas are levelled after they are taken
_BAND = 5  # samples on both sides of the outline that are compared
_APART, _AROUND_BAND = 10, 30  # samples from the outline to the surroundings that it is compared with
_FITS, _FITS_AROUND = (
    0.5,
    0.6,
)  # least correlation of a static outline; most of its surroundings, relative to that
_PAIRS = 0.6  # of the pairs of views must show that; one view with glare on the tripod spoils two in five
_LEGS_FROM = 4  # panoramas; with fewer, things that stay by chance are too common to follow
_THICK, _WANDER, _GAP = 5, 5, 7  # samples: a leg's half thickness, its way from view to view, breaks in it
_CONTRAST = 0.045  # grey levels of a leg against the floor
_MARGIN = 3  # samples added round the region: its blurred edge is no scene either


def detect_static_region(images: Float[Tensor, "view 3 height width"]) -> Bool[Tensor, "height width"]:
    """Where panoramas show the scene: False in regions round the poles that stay in place in all of them.

    A panorama that hardly differs from another one bears no witness (a camera that did not move sees
    everything in place); with fewer than two that differ nothing is masked.
    """
    height, width = images.shape[-2:]
    size = (2 * _HEIGHT, _HEIGHT)
    grey = images.float().mean(dim=1).cpu().numpy()
    grey = _distinct(np.stack([cv2.resize(g, size, interpolation=cv2.INTER_AREA) for g in grey]))
    if len(grey) < 2:
        return torch.ones(height, width, dtype=torch.bool)
    zenith = _static_cap(grey)
    nadir = _static_cap(np.ascontiguousarray(grey[:, ::-1]))[::-1]
    static = np.maximum(zenith, nadir).astype(np.float32)
    return torch.from_numpy(cv2.resize(static, (width, height), interpolation=cv2.INTER_LINEAR) < 0.5)


def static_mask_of_files(paths: tuple[Path, ...], height: int) -> Bool[Tensor, "height width"]:
    """`detect_static_region` of panorama files at (height, 2 height); unreadable files are passed over.

    The result for the same files is kept in memory.
    """
    if len(paths) > _MOST_IMAGES:
        paths = tuple(paths[i] for i in np.linspace(0, len(paths) - 1, _MOST_IMAGES).round().astype(int))
    stamped = tuple((path, path.stat().st_mtime_ns, path.stat().st_size) for path in paths if path.is_file())
    scene = _cached_mask(stamped)
    if scene.all():
        return torch.ones(height, 2 * height, dtype=torch.bool)
    resized = cv2.resize(scene.astype(np.float32), (2 * height, height), interpolation=cv2.INTER_LINEAR)
    return torch.from_numpy(resized >= 0.5)


@lru_cache(maxsize=32)
def _cached_mask(stamped: tuple[tuple[Path, int, int], ...]) -> NDArray[np.bool_]:
    images = []
    for path, *_ in stamped:
        try:
            images.append(read_thumbnail(path, _HEIGHT))
        except InputError:  # only a witness; it raises its error when it is loaded itself
            continue
    if len(images) < 2:
        return np.ones((_HEIGHT, 2 * _HEIGHT), dtype=bool)
    return detect_static_region(torch.stack(images)).numpy()


def _distinct(grey: Array) -> Array:
    kept: list[int] = []
    for i in range(len(grey)):
        if all(np.abs(grey[i] - grey[j]).mean() > _MOVED for j in kept):
            kept.append(i)
    return grey[kept]


def _static_cap(grey: Array) -> NDArray[np.bool_]:
    """The static region round the upper pole of (view height width) panoramas, in their pixels."""
    none = np.zeros(grey.shape[1:], dtype=bool)
    agreed = _agreed(_ring_edges(grey))
    outline = _closed_outline(agreed)
    edges = agreed[outline, np.arange(_SECTORS)]
    if (edges > _EDGE).mean() < _AROUND:
        return none
    discs = np.stack([_disc(g) for g in grey])
    inside = _inside(outline)
    if not _stays(discs, inside):
        return none
    region = cv2.dilate(inside, _round(1))
    if len(discs) >= _LEGS_FROM:
        region = _with_legs(discs, region)
    return _cap_from_disc(cv2.dilate(region, _round(_MARGIN)), grey.shape[1])


def _sample(grey: Array, colatitude: Array, azimuth: Array) -> Array:
    """Bilinear samples of one panorama at degrees from its upper pole and degrees from its left edge."""
    height = grey.shape[0]
    blurred = cv2.GaussianBlur(grey, (0, 0), 0.7)
    padded = cv2.copyMakeBorder(blurred, 0, 0, 2, 2, cv2.BORDER_WRAP)
    x = azimuth / 180 * height - 0.5 + 2
    y = colatitude / 180 * height - 0.5
    return cv2.remap(
        padded, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )


def _ring_edges(grey: Array) -> Array:
    """Outward grey differences over two degrees, (view ring sector)."""
    rings, sectors = (np.arange(_RINGS) + 0.5) * _STEP, (np.arange(_SECTORS) + 0.5) * 360 / _SECTORS
    azimuth, colatitude = np.meshgrid(sectors, rings)
    kernel = np.array([[-0.5], [-0.5], [0], [0.5], [0.5]], dtype=np.float32)
    maps = [_sample(g, colatitude, azimuth) for g in grey]
    return np.stack([cv2.filter2D(m, -1, kernel, borderType=cv2.BORDER_REPLICATE) for m in maps])


def _agreed(signed: Array) -> Array:
    """Size of the edge that all but a few views (axis 0) have with one sign, 0 where they differ."""
    low, high = np.quantile(signed, (_AGREEMENT, 1 - _AGREEMENT), axis=0)
    return np.maximum(np.maximum(low, 0), np.maximum(-high, 0)).astype(np.float32)


def _closed_outline(agreed: Array) -> NDArray[np.intp]:
    """Ring of each sector of the closed curve round the pole with the most edge, by dynamic programming.

    Two turns are optimised and the middle one taken, so that the curve closes.
    """
    rings, sectors = agreed.shape
    gain = np.minimum(agreed, 3 * _EDGE)  # a few strong edges do not buy a way through nothing
    gain[: int(_SMALLEST / _STEP)] = -1
    gain[int(_LARGEST / _STEP) :] = -1
    score = np.zeros(rings)
    came_from = np.empty((2 * sectors, rings), dtype=np.intp)
    steps = np.arange(-_BEND, _BEND + 1)
    source = np.clip(np.arange(rings)[None] + steps[:, None], 0, rings - 1)
    for turn in range(2 * sectors):
        candidates = score[source] - 0.1 * _EDGE * np.abs(steps)[:, None]
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


def _disc_grid() -> tuple[Array, Array]:
    """x, y of the samples of a flat map round the pole, degrees; as wide as the reach on each side."""
    axis = ((np.arange(2 * _RINGS) + 0.5) * _STEP - _REACH).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    return x, y


def _disc_radius() -> Array:
    return np.hypot(*_disc_grid())


def _disc_azimuth() -> Array:
    x, y = _disc_grid()
    return np.degrees(np.arctan2(y, x)) % 360


def _disc(grey: Array) -> Array:
    """Flat (azimuthal equidistant) map of one panorama round its upper pole."""
    return _sample(grey, _disc_radius(), _disc_azimuth())


def _inside(outline: NDArray[np.intp]) -> NDArray[Any]:
    """The disc samples within the outline."""
    sector = (_disc_azimuth() / 360 * _SECTORS).astype(int) % _SECTORS
    return (_disc_radius() <= (outline[sector] + 0.5) * _STEP).astype(np.uint8)


def _round(samples: int) -> NDArray[Any]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * samples + 1, 2 * samples + 1))


def _gradients(disc: Array) -> Array:
    """(2 y x) grey differences over a degree."""
    return np.stack([cv2.Scharr(disc, -1, dx, dy) / 16 for dx, dy in ((1, 0), (0, 1))])


def _stays(discs: Array, inside: NDArray[Any]) -> bool:
    """Whether the edges of the outline stay while those around it move, in most pairs of views.

    Where little moves at all (a short baseline below a high ceiling) the surroundings fit as well as the
    outline, and nothing is known.
    """
    near = _disc_radius() < _REACH
    outline = (cv2.dilate(inside, _round(_BAND)) > cv2.erode(inside, _round(_BAND))) & near
    around = (cv2.dilate(inside, _round(_AROUND_BAND)) > cv2.dilate(inside, _round(_APART))) & near
    views = range(len(discs))
    pairs = list(itertools.combinations(views, 2)) if len(discs) <= 5 else list(itertools.pairwise(views))
    gradients = [np.clip(_gradients(disc), -0.1, 0.1) for disc in discs]
    stay = []
    for i, j in pairs:
        fit = _best_fit(gradients[i], gradients[j], outline)
        stay.append(fit > _FITS and _best_fit(gradients[i], gradients[j], around) < _FITS_AROUND * fit)
    return float(np.mean(stay)) >= _PAIRS


def _best_fit(first: Array, second: Array, where: NDArray[np.bool_]) -> float:
    """Correlation of two views' edges at the best small shift, in [-1, 1]."""
    y, x = np.nonzero(where)
    fixed = first[:, y, x]
    limit = first.shape[-1] - 1
    best = -1.0
    for dy in range(-_SHIFT, _SHIFT + 1):
        for dx in range(-_SHIFT, _SHIFT + 1):
            moved = second[:, np.clip(y + dy, 0, limit), np.clip(x + dx, 0, limit)]
            norm = float(np.sqrt((fixed * fixed).sum() * (moved * moved).sum()))
            best = max(best, float((fixed * moved).sum()) / norm if norm > 0 else 0.0)
    return best


def _with_legs(discs: Array, region: NDArray[Any]) -> NDArray[Any]:
    """The region with the thin things joined to it that nearly all views have at about one place."""
    parts = np.zeros_like(region)
    for operation in (cv2.MORPH_BLACKHAT, cv2.MORPH_TOPHAT):
        thin = [cv2.morphologyEx(disc, operation, _round(_THICK)) for disc in discs]
        # Widened by what a thing may be off by from view to view, so that all views agree somewhere.
        agreed = np.quantile([cv2.dilate(t, _round(_WANDER)) for t in thin], _AGREEMENT, axis=0)
        parts |= (agreed > _CONTRAST).astype(np.uint8)
    joined = cv2.morphologyEx(region | parts, cv2.MORPH_CLOSE, _round(_GAP))
    _, labels = cv2.connectedComponents(joined, connectivity=8)
    found = (labels == labels[_RINGS, _RINGS]) & (labels > 0) & (_disc_radius() < _REACH)
    return found.astype(np.uint8) | region


def _cap_from_disc(disc: NDArray[Any], height: int) -> NDArray[np.bool_]:
    """A disc map as a panorama (height, 2 height), False beyond its reach."""
    colatitude = (np.arange(height) + 0.5) * 180 / height
    azimuth = np.radians((np.arange(2 * height) + 0.5) * 180 / height)
    x = (colatitude[:, None] * np.cos(azimuth) + _REACH) / _STEP - 0.5
    y = (colatitude[:, None] * np.sin(azimuth) + _REACH) / _STEP - 0.5
    return cv2.remap(disc, x.astype(np.float32), y.astype(np.float32), cv2.INTER_NEAREST) > 0
