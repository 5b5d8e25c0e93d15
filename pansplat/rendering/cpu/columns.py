"""Omni-directional stereo: every column of a panorama rasterised from its own eye on the viewing circle.

A Gaussian is listed once for each column that it can reach, as a pair of Gaussian and column, and the pairs go through
the stages of any image: projection from the column's eye, bounding box (cut to the column), tiles, compositing. The
image is folded (`tabulate_columns`), so that no block of pixels has two columns.

Source: docs/rendering.md, section 9.
"""

import math
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pansplat.constants import ALPHA_CUT, KAPPA_MARGIN
from pansplat.rendering.cpu.projection import (
    GAUSSIANS_PER_ITEM,
    Camera,
    GaussianArrays,
    project_gaussians,
)
from pansplat.rendering.cpu.rasterize import rasterize_forward
from pansplat.rendering.cpu.records import BLOCK_WIDTH, TILE_SIZE, tabulate_columns
from pansplat.rendering.cpu.runtime import Workspace, inline_kernel, kernel, parallel_for, pooled_empty
from pansplat.rendering.cpu.simd import load_scalar, store_scalar
from pansplat.rendering.cpu.tiling import (
    EMPTY_BOX,
    MAX_INTERSECTIONS,
    find_bounding_boxes,
    intersect_tiles,
    sort_front_to_back,
)
from pansplat.rendering.cpu.view import CameraView
from pansplat.rendering.image_planes import ImagePlane

_MAX_PAIRS = 1 << 19  # pairs in a strip of columns, unless one tile's width has more: 60 MB of records and values
_MAX_COLUMNS = 4096  # columns in a strip, whose folded image is four times as wide
_MAX_SINE = 0.99  # sine of the angle between a column and a mean, above which every column is tested
_PARTS_PER_THREAD = 4


class _ColumnRanges(NamedTuple):
    """The columns that each Gaussian can reach: `counts` columns from `first` on, which wrap around the panorama."""

    first: Int[np.ndarray, "n"]
    counts: Int[np.ndarray, "n"]


class _Pairs(NamedTuple):
    """Pairs of a Gaussian and a column, in the order of the Gaussians."""

    gaussians: Int[np.ndarray, "pair"]
    columns: Int[np.ndarray, "pair"]


def rasterize_columns(view: CameraView, plane: ImagePlane, sums: Float[np.ndarray, "sums height width"]) -> None:
    """Write the sums of a panorama whose columns have their own eyes.

    Args:
        view: the projection is that of the centre of the viewing circle.
        plane: a direct panorama with an eye offset; its rotation is the identity.
        sums: written.
    """
    threads, width = view.threads, plane.size[1]
    eyes = plane.column_eyes().numpy()
    workspace = Workspace()
    ranges = _find_columns(view, plane, workspace)
    for low, high in _split_columns(ranges, width):
        strip = Workspace()
        pairs = _list_pairs(ranges, low, high, width, strip, threads)
        gaussians = _gather(view.gaussians, view.camera, eyes, pairs, strip, threads)
        pose = view.camera.pose.copy()
        pose[:3, 3] = 0
        projected = project_gaussians(gaussians, view.camera._replace(pose=pose), strip, threads)
        boxes = find_bounding_boxes(projected.records, plane, strip, threads)
        cut = partial(_cut_to_columns, boxes.view(np.int64)[:, 0], pairs.columns, low)
        parallel_for(cut, -(-len(boxes) // GAUSSIANS_PER_ITEM), threads)
        tables = tabulate_columns(plane, low, high)
        size = len(tables.rows), len(tables.columns)
        folded = pooled_empty((len(sums), *size), np.float32)
        for tiles in intersect_tiles(boxes, size, slots=False, threads=threads, limit=MAX_INTERSECTIONS):
            sort_front_to_back(tiles, projected.radii, threads)
            rasterize_forward(
                projected.records, projected.values, tiles.intersections, tiles.starts, tables, folded,
                first_row=tiles.first_row, threads=threads, min_transmittance=view.min_transmittance,
            )  # fmt: skip
        unfolded = folded.reshape(len(sums), size[0], high - low, BLOCK_WIDTH).transpose(0, 1, 3, 2)
        sums[:, :, low:high] = unfolded.reshape(len(sums), -1, high - low)[:, : plane.size[0]]


def _find_columns(view: CameraView, plane: ImagePlane, workspace: Workspace) -> _ColumnRanges:
    """The columns that each Gaussian can reach; none for unusable Gaussians."""
    gaussians, camera, num = view.gaussians, view.camera, len(view.gaussians.means)
    ranges = _ColumnRanges(workspace.array(num, np.int32), workspace.array(num, np.int32))
    # Whether a Gaussian is too near depends on the column.
    near = view.projected.radii < camera.near + abs(plane.eye_offset)
    usable = view.projected.kept.astype(bool) | near
    work = partial(
        _bound_columns, gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, usable,
        camera.pose, camera.filter_variance, plane.eye_offset, plane.size[1], *ranges,
    )  # fmt: skip
    parallel_for(work, -(-num // GAUSSIANS_PER_ITEM), view.threads)
    return ranges


@kernel
def _bound_columns(
    means, quats, scales, opacities, usable, pose, filter_variance, eye_offset, width, first, counts, item
):  # fmt: skip
    """Write the columns whose half planes can meet the visible ellipsoid of a Gaussian.

    With h and theta the horizontal distance and longitude of the mean, and a = theta - longitude of the column, the
    mean is h sin a - eye_offset to the side of the column's half plane. The ellipsoid reaches at most
    k (|cos a| sigma_across + |sin a| sigma_along) + k e r to the side.
    """
    covariance, rotation = np.empty((3, 3)), np.empty((3, 3))
    deviation, margin, offset = math.sqrt(filter_variance), 0.01 + 1e-6 * width, abs(eye_offset)
    for g in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, means.shape[0])):
        first[g], counts[g] = 0, 0
        if not usable[g]:
            continue
        p_x, p_y, p_z = means[g, 0] - pose[0, 3], means[g, 1] - pose[1, 3], means[g, 2] - pose[2, 3]
        x = p_x * pose[0, 0] + p_y * pose[1, 0] + p_z * pose[2, 0]
        z = p_x * pose[0, 2] + p_y * pose[1, 2] + p_z * pose[2, 2]
        horizontal, radius = math.hypot(x, z), math.sqrt(p_x * p_x + p_y * p_y + p_z * p_z)
        _fill_rotation(quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3], rotation)
        for i in range(3):
            for j in range(3):
                covariance[i, j] = 0.0
                for k in range(3):
                    covariance[i, j] += rotation[i, k] * rotation[j, k] * np.float64(scales[g, k]) ** 2
        kappa = 2 * math.log(max(opacities[g] / ALPHA_CUT, 1.0)) + KAPPA_MARGIN
        reach = 1.001 * math.sqrt(kappa)
        widening = reach * deviation * (radius + offset)
        largest = math.sqrt(max(covariance[0, 0] + covariance[1, 1] + covariance[2, 2], 0.0))  # an upper bound
        counts[g] = width
        if not horizontal > 1e-9 * radius:
            continue
        cosine, sine = z / horizontal, x / horizontal
        along, across = np.empty(3), np.empty(3)
        for i in range(3):
            along[i] = sine * pose[i, 0] + cosine * pose[i, 2]
            across[i] = cosine * pose[i, 0] - sine * pose[i, 2]
        deviation_along, deviation_across = _deviation(covariance, along), _deviation(covariance, across)
        inner, outer = horizontal - reach * deviation_along, horizontal + reach * deviation_along
        if not inner > 1e-3 * horizontal:
            continue
        upper = eye_offset + reach * deviation_across + widening
        lower = eye_offset - reach * deviation_across - widening
        upper, lower = upper / (inner if upper > 0 else outer), lower / (inner if lower < 0 else outer)
        sine_limit = max(abs(upper), abs(lower))
        if not sine_limit < _MAX_SINE:
            continue
        if horizontal * math.sqrt(1 - sine_limit * sine_limit) <= reach * largest + widening:
            continue
        theta, per_radian = math.atan2(x, z), width / (2 * math.pi)
        start = math.ceil((theta - math.asin(upper)) * per_radian + 0.5 * width - 0.5 - margin)
        end = math.floor((theta - math.asin(lower)) * per_radian + 0.5 * width - 0.5 + margin)
        if end - start + 1 < width:
            first[g], counts[g] = start % width, max(end - start + 1, 0)


@inline_kernel
def _fill_rotation(w, x, y, z, rotation):
    """Write the rotation of a quaternion of any length; zero gives the identity."""
    norm2 = np.float64(w) * w + np.float64(x) * x + np.float64(y) * y + np.float64(z) * z
    twice = 2 / norm2 if norm2 > 0 else 0.0
    rotation[0, 0], rotation[1, 1] = 1 - twice * (y * y + z * z), 1 - twice * (x * x + z * z)
    rotation[2, 2] = 1 - twice * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = twice * (x * y - w * z), twice * (x * y + w * z)
    rotation[0, 2], rotation[2, 0] = twice * (x * z + w * y), twice * (x * z - w * y)
    rotation[1, 2], rotation[2, 1] = twice * (y * z - w * x), twice * (y * z + w * x)


@inline_kernel
def _deviation(covariance, axis):
    """Standard deviation along a unit axis."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += axis[i] * covariance[i, j] * axis[j]
    return math.sqrt(max(total, 0.0))


def _split_columns(ranges: _ColumnRanges, width: int) -> Iterator[tuple[int, int]]:
    """Split the columns into strips of at most `_MAX_PAIRS` pairs, one column at least, of whole tiles if possible."""
    some = ranges.counts > 0
    change = np.bincount(ranges.first[some], minlength=2 * width + 1)
    change = change - np.bincount(ranges.first[some] + ranges.counts[some], minlength=2 * width + 1)
    covered = np.cumsum(change)
    pairs = np.concatenate((np.zeros(1, np.int64), np.cumsum(covered[:width] + covered[width : 2 * width])))
    low, tile = 0, TILE_SIZE // BLOCK_WIDTH
    while low < width:
        high = int(np.searchsorted(pairs, pairs[low] + _MAX_PAIRS, side="right")) - 1
        high = min(max(high, low + 1), low + _MAX_COLUMNS, width)
        if high < width and high - low > tile:
            high -= high % tile
        yield low, high
        low = high


def _list_pairs(ranges: _ColumnRanges, low: int, high: int, width: int, workspace: Workspace, threads: int) -> _Pairs:
    """The pairs of columns `low` to `high` - 1."""
    parts = _PARTS_PER_THREAD * threads
    edges = np.linspace(0, len(ranges.first), parts + 1).astype(np.int64)
    counts = np.zeros(parts, np.int64)
    parallel_for(partial(_count_pairs, edges, *ranges, low, high, width, counts), parts, threads)
    total = int(counts.sum())
    pairs = _Pairs(workspace.array(total, np.int32), workspace.array(total, np.int32))
    starts = np.cumsum(counts) - counts
    parallel_for(partial(_write_pairs, edges, *ranges, low, high, width, starts, *pairs), parts, threads)
    return pairs


@kernel
def _count_pairs(edges, first, counts, low, high, width, part_counts, part):
    total = 0
    for g in range(edges[part], edges[part + 1]):
        start = np.int64(load_scalar(first, g))
        end = start + np.int64(load_scalar(counts, g))
        total += max(min(end, high) - max(start, low), 0) + max(min(end - width, high) - max(start - width, low), 0)
    part_counts[part] = total


@kernel
def _write_pairs(edges, first, counts, low, high, width, starts, gaussians, columns, part):
    at = np.int64(starts[part])
    for g in range(edges[part], edges[part + 1]):
        start = np.int64(load_scalar(first, g))
        end = start + np.int64(load_scalar(counts, g))
        for shift in range(0, 2 * width, width):  # a range that wraps around is two ranges
            for column in range(max(start - shift, low), min(end - shift, high)):
                store_scalar(gaussians, at, np.int32(g))
                store_scalar(columns, at, np.int32(column))
                at += 1


def _gather(
    gaussians: GaussianArrays, camera: Camera, eyes: np.ndarray, pairs: _Pairs, workspace: Workspace, threads: int
) -> GaussianArrays:
    """The Gaussian of each pair; its mean is relative to the column's eye."""
    num = len(pairs.gaussians)
    centres = camera.pose[:3, 3] + eyes @ camera.pose[:3, :3].T
    arrays = [workspace.array((num, *array.shape[1:]), np.float32) for array in gaussians]
    sources = [array.reshape(-1) for array in gaussians]
    row_sizes = np.array([math.prod(array.shape[1:]) for array in gaussians[1:]])
    work = partial(_gather_rows, *sources, row_sizes, centres, *pairs, *(array.reshape(-1) for array in arrays))
    parallel_for(work, -(-num // GAUSSIANS_PER_ITEM), threads)
    return GaussianArrays(*arrays)


@kernel
def _gather_rows(
    means, quats, scales, opacities, harmonics, row_sizes, centres, indices, columns,
    moved, to_quats, to_scales, to_opacities, to_harmonics, item,
):  # fmt: skip
    """Copy the Gaussian of each pair; its mean becomes relative to the column's eye."""
    begin, end = item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, len(indices))
    eyes = centres.reshape(-1)
    for i in range(begin, end):
        g, column = 3 * np.int64(load_scalar(indices, i)), 3 * np.int64(load_scalar(columns, i))
        for axis in range(3):
            offset = np.float64(load_scalar(means, g + axis)) - load_scalar(eyes, column + axis)
            store_scalar(moved, 3 * i + axis, np.float32(offset))
    _copy_rows(quats, row_sizes[0], indices, begin, end, to_quats)
    _copy_rows(scales, row_sizes[1], indices, begin, end, to_scales)
    _copy_rows(opacities, row_sizes[2], indices, begin, end, to_opacities)
    _copy_rows(harmonics, row_sizes[3], indices, begin, end, to_harmonics)


@inline_kernel
def _copy_rows(source, row_size, indices, begin, end, copies):
    for i in range(begin, end):
        at = row_size * np.int64(load_scalar(indices, i))
        for j in range(row_size):
            store_scalar(copies, row_size * i + j, load_scalar(source, at + j))


@kernel
def _cut_to_columns(words, columns, low, item):
    """Cut the box of each pair to its column of the folded image; boxes that do not reach it become empty."""
    mask = np.int64(0xFFFF)
    for i in range(item * GAUSSIANS_PER_ITEM, min((item + 1) * GAUSSIANS_PER_ITEM, len(words))):
        word, column = words[i], np.int64(columns[i])
        x0, x1 = word & mask, word >> 16 & mask
        inside = (x0 <= column) & (column <= x1) if x0 <= x1 else (column >= x0) | (column <= x1)
        if inside & (word != EMPTY_BOX):
            x0, x1 = BLOCK_WIDTH * (column - low), BLOCK_WIDTH * (column - low) + BLOCK_WIDTH - 1
            y0, y1 = (word >> 32 & mask) // BLOCK_WIDTH, (word >> 48) // BLOCK_WIDTH
            words[i] = x0 | x1 << 16 | y0 << 32 | y1 << 48
        else:
            words[i] = EMPTY_BOX
