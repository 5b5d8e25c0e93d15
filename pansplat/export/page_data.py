"""The data of a page: `PageHeader`, which its modules read as HEADER, and the Gaussians as compressed bytes.

The layout of the bytes is in docs/web.md.
"""

from __future__ import annotations

import gzip
import io
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import msgspec
import numpy as np
from jaxtyping import Float, UInt8

from pansplat import constants
from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.morton import morton_codes
from pansplat.geometry.pose import AHEAD_EXPONENT
from pansplat.system.files import SOFTWARE
from pansplat.tours import route
from pansplat.tours.layout import REACH
from pansplat.tours.limits import CLEARANCE, EDGE_HYSTERESIS, POOR_REACH
from pansplat.tours.links import RING_DISTANCE, RING_RADIUS

MAX_DEGREE = 3  # highest degree of the harmonics of a page
BATCH = 256  # quads that are drawn together
_CONSTANT_BYTES = 23  # size of a Gaussian without harmonics of degree 1 and above
_MORTON_BITS = 10  # bits of each coordinate in the order of a Z-curve
_CLIPPED = 1e-3  # fraction of colours beyond each end of the range of bytes


Vector: TypeAlias = tuple[float, float, float]  # axes of the scene's world, relative to the page's origin


class _Record(msgspec.Struct, frozen=True, rename="camel", forbid_unknown_fields=True):
    """A JSON object of a page."""


class PageView(_Record):
    """The Gaussians of a view: the first one, their number, and the files that hold them."""

    start: int
    count: int
    files: tuple[str, ...] = ()


class PageNote(_Record):
    """A note of the tour, in a direction of the scene's world."""

    direction: Vector
    text: str
    addresses: tuple[str, ...]


class PageRing(_Record):
    """A ring to a panorama, and where it is if a link leads there; else it is at the panorama's own mark."""

    node: int
    mark: Vector | None


class PageSpot(_Record):
    """A panorama: its camera, the mark of its ring on the floor, and where there is something to see.

    Attributes:
        ahead: yaw and pitch of its start view, else of the widest one, radians.
        has_start: whether it has a start view.
        turns: what a camera that arrives in each direction of the horizon turns by (`find_turns`), radians.
        rings: that are offered at it (`choose_rings`).
        clearances: distances of the nearest surfaces around the camera (`measure_clearance`).
    """

    name: str
    position: Vector
    mark: Vector
    notes: tuple[PageNote, ...]
    ahead: tuple[float, float]
    has_start: bool
    turns: tuple[float, ...]
    rings: tuple[PageRing, ...]
    clearances: tuple[tuple[float, ...], ...]


class PageLink(_Record):
    """A link of the tour and its direction, radians."""

    source: int = msgspec.field(name="from")
    target: int = msgspec.field(name="to")
    text: str
    yaw: float
    pitch: float


class PagePhotograph(_Record):
    """The tiles of a photograph: the size of a face and of a tile of each level, and its rotation to the world."""

    name: str
    levels: tuple[tuple[int, int], ...]
    rotation: tuple[Vector, Vector, Vector]


class PagePlan(_Record):
    """The floor plan.

    Attributes:
        worlds: of each panorama.
        drawing: an SVG, base64.
        is_sure: whether the places of all rooms are known; else some are dashed.
        size: its width and height, metres.
        places: of each panorama, to the right and down from the upper left corner, metres; and what yaws there are
            turned by, radians to the right, None if that is unknown.
    """

    worlds: tuple[int, ...]
    drawing: str
    is_sure: bool
    size: tuple[float, float]
    places: tuple[tuple[float, float, float | None], ...]


class PageHouse(_Record):
    """A doll's house: its panoramas, and corners of triangles, clockwise in front: x, y, z, and u, v in the atlas.
    In triangles of wall tops u and v are 2 + the wall's normal (right, forward). `moves`: what the
    surroundings of each panorama are turned by, radians to the right, and where its camera is then."""

    nodes: tuple[int, ...]
    moves: tuple[tuple[float, float, float, float], ...]
    corners: tuple[tuple[float, float, float, float, float], ...]


class PageConstants(_Record, kw_only=True):
    """Numbers that the page shares with the window and films; the modules that own them say what they are. Angles are
    in radians, fields of view in degrees."""

    ahead: float = AHEAD_EXPONENT
    batch: int = BATCH
    near: float = constants.NEAR
    filter_variance: float = constants.FILTER_VARIANCE
    tallest: float = 1.5  # height of a portrait image relative to a landscape one
    start_fov: float = 75.0  # vertical field of view of a landscape image at the start, degrees
    min_fov: float = constants.MIN_FOV_DEGREES
    max_fov: float = constants.MAX_FOV_DEGREES
    max_pitch: float = math.radians(constants.MAX_PITCH_DEGREES)
    speed: float = constants.WALK_SPEED
    fast: float = constants.FAST
    clearance: float = CLEARANCE
    poor_reach: float = POOR_REACH
    hysteresis: float = EDGE_HYSTERESIS
    reach: float = REACH
    ring_radius: float = RING_RADIUS
    ring_distance: float = RING_DISTANCE
    fade_seconds: float = route.FADE_SECONDS
    stop_reach: float = route.STOP_REACH
    stop_seconds: float = route.STOP_SECONDS
    rest_seconds: float = route.REST_SECONDS
    turn_seconds: float = route.TURN_SECONDS
    turn_angle: float = math.radians(route.TURN_DEGREES)
    zoom_seconds: float = route.ZOOM_SECONDS
    zoom: float = route.ZOOM
    lowest_pitch: float = route.LOWEST_PITCH
    flight_seconds: tuple[float, float] = route.FLIGHT_SECONDS
    short_flight: float = route.SHORT_FLIGHT
    metre_seconds: float = route.METRE_SECONDS
    covered: float = route.COVERED
    surfaces: float = route.SURFACES
    most_beside: float = route.MOST_BESIDE


class PageHeader(PageConstants, kw_only=True):
    """All numbers of a page but those of single Gaussians.

    Attributes:
        count, degree, color_range, harmonics_scale: of the Gaussians (`PackedGaussians`).
        loading: views in the order of their data.
        level: axes of a level camera (columns right, down, forward).
        parts, groups, edges, next, poor: the graph of the tour (graph.js).
        walk: the panoramas in the order of a visit of all; the page starts at the first one.
        unit: of a metre in the page.
        limits: how far the camera may go in each part; 0 where it stands at photographs, and there are no Gaussians.
        folder: address of the folder with the files; None of a page in one file.
    """

    count: int
    degree: int
    color_range: tuple[float, float]
    harmonics_scale: float
    views: tuple[PageView, ...]
    loading: tuple[int, ...]
    spots: tuple[PageSpot, ...]
    links: tuple[PageLink, ...]
    level: tuple[Vector, Vector, Vector]
    parts: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    edges: tuple[tuple[int, int, int], ...]
    next: tuple[tuple[int, ...], ...]
    poor: tuple[tuple[int, int], ...]
    walk: tuple[int, ...]
    unit: float
    limits: tuple[float, ...]
    doll: tuple[PageHouse, ...]
    photographs: tuple[PagePhotograph, ...]
    plan: PagePlan
    folder: str | None


@dataclass(frozen=True, eq=False)
class PackedGaussians:
    """Gaussians as the bytes that a web page reads.

    Attributes:
        contents: gzip of planes of bytes of each view.
        views: the Gaussians of each, without files.
        degree: of the harmonics.
        color_range: colours of the bytes 0 and 255.
        harmonics_scale: coefficient of the byte 127.
    """

    contents: tuple[bytes, ...]
    views: tuple[PageView, ...]
    degree: int
    color_range: tuple[float, float]
    harmonics_scale: float


def count_bytes(count: int, degree: int) -> int:
    """Size of the planes of a number of Gaussians before the compression."""
    return count * (_CONSTANT_BYTES + 3 * ((degree + 1) ** 2 - 1))


def pack_gaussians(
    gaussians: Gaussians,
    origin: Float[np.ndarray, "3"],
    order: Sequence[int],
    degree: int,
) -> PackedGaussians:
    """Quantise and compress Gaussians.

    Args:
        gaussians: finite numbers, three channels.
        origin: subtracted from the means.
        order: all views, in which a page needs them.
        degree: highest degree of harmonics that is kept, at most MAX_DEGREE.
    """
    degree = min(degree, gaussians.degree, MAX_DEGREE)
    ranks = np.argsort(order)[gaussians.views.cpu().numpy()]
    means = (gaussians.means.double().cpu().numpy() - origin).astype(np.float32)
    # Neighbours in the file are neighbours in space, so that equal upper bytes follow each other.
    chosen = np.lexsort((_morton_codes(means), ranks))
    means, scales = means[chosen], np.abs(gaussians.scales.float().cpu().numpy()[chosen])
    harmonics = gaussians.harmonics.float().cpu().numpy()[chosen]
    colors = 0.5 + SH_0 * harmonics[:, 0]
    lowest, highest = np.quantile(colors, (_CLIPPED, 1 - _CLIPPED)).tolist() if colors.size else (0.0, 1.0)
    low, high = min(0.0, lowest) if degree else 0.0, max(1.0, highest)  # without other harmonics black is the least
    planes = [
        *(plane for axis in range(3) for plane in _split_floats(means[:, axis], 3)),
        *(plane for axis in range(3) for plane in _split_floats(scales[:, axis], 2)),
        *_split_words(_pack_quats(gaussians.quats.double().cpu().numpy()[chosen]), 4),
        _to_bytes(gaussians.opacities.float().cpu().numpy()[chosen], 255.0),
        *(_to_bytes(colors[:, channel] - low, 255.0 / (high - low)) for channel in range(3)),
    ]
    higher = harmonics[:, 1 : (degree + 1) ** 2].reshape(len(means), 3 * ((degree + 1) ** 2 - 1))
    scale = max(float(np.quantile(np.abs(higher), 1 - _CLIPPED)) if higher.size else 0.0, 1e-6)
    quantised = np.clip(np.round(higher * (127.0 / scale)), -127, 127).astype(np.int8).view(np.uint8)
    ends = np.searchsorted(ranks[chosen], np.arange(len(order) + 1))
    blocks = [
        b"".join(plane[start:end].tobytes() for plane in (*planes, *quantised.T)) for start, end in pairwise(ends)
    ]
    with ThreadPoolExecutor() as threads:
        contents = tuple(threads.map(_compress, (blocks[rank] for rank in np.argsort(order))))
    views = tuple(PageView(int(ends[rank]), int(ends[rank + 1] - ends[rank])) for rank in np.argsort(order))
    return PackedGaussians(contents, views, degree, (low, high), scale)


def _compress(block: bytes) -> bytes:
    """gzip, whose header names the software: another page may replace the file."""
    with io.BytesIO() as file:
        with gzip.GzipFile(SOFTWARE, "wb", 9, file, mtime=0) as stream:
            stream.write(block)
        return file.getvalue()


def _morton_codes(points: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Positions along a Z-order curve through the box of the middle 98 % of the points."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(points, 0.01, axis=0), np.quantile(points, 0.99, axis=0)
    size = np.maximum(high - low, 1e-12)
    cells = np.clip((points - low) / size * (1 << _MORTON_BITS), 0, (1 << _MORTON_BITS) - 1).astype(np.int64)
    return morton_codes(cells)


def _split_words(words: np.ndarray, count: int) -> list[UInt8[np.ndarray, "n"]]:
    """The `count` most significant bytes of 32-bit words, a plane each."""
    return [(words >> np.uint32(24 - 8 * k)).astype(np.uint8) for k in range(count)]


def _split_floats(values: Float[np.ndarray, "n"], count: int) -> list[UInt8[np.ndarray, "n"]]:
    """The upper bytes of float32 numbers, rounded to the nearest."""
    half = np.uint32(1 << (31 - 8 * count))
    return _split_words(np.ascontiguousarray(values, np.float32).view(np.uint32) + half, count)


def _pack_quats(quats: Float[np.ndarray, "n 4"]) -> np.ndarray:
    """Unit quaternions in 32 bits: the index of the largest component, and the others with 10 bits each."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms > 0, quats / np.maximum(norms, 1e-300), (1.0, 0.0, 0.0, 0.0))
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = np.array([[k for k in range(4) if k != index] for index in range(4)])[largest]
    values = np.round(np.take_along_axis(quats, others, 1) * (511 * math.sqrt(2))).astype(np.int64) + 511
    words = largest.astype(np.int64) << 30
    for k in range(3):
        words |= np.clip(values[:, k], 0, 1022) << (20 - 10 * k)
    return words.astype(np.uint32)


def _to_bytes(values: Float[np.ndarray, "n"], factor: float) -> UInt8[np.ndarray, "n"]:
    return np.clip(np.round(values * factor), 0, 255).astype(np.uint8)
