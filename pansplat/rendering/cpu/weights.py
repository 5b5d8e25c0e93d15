"""The blending weights of a panorama, stored, so that images with other colours need no projection and no alphas.

An image is linear in the colours: C = W c, with a row of W for each pixel and a column for each Gaussian. Stored are
the weights of the pairs of a block of pixels and a Gaussian that it sees, by tile, chunk and block in the order of
compositing (rasterize.py). The transposed product W' x has a slot for each tile intersection, whose sums are added in a
fixed order, as in the backward.

Source: docs/rendering.md, section 4.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.constants import NEAR
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering.cpu.projection import GaussianArrays, project_gaussians
from pansplat.rendering.cpu.projection_backward import accumulate_slots
from pansplat.rendering.cpu.rasterize import (
    BLOCKS_ACROSS,
    BUFFER_SIZE,
    CHUNK_SIZE,
    CHUNK_WORDS,
    FOOTPRINT_SIZE,
    MIN_TRANSMITTANCE,
    NUM_BLOCKS,
    NUM_MASKS,
    ROW_MASKS,
    TILE_FRAME_SIZE,
    TILE_PIXELS,
    VALUE_LANES,
    compute_alpha,
    compute_log2_alphas,
    image_position,
    load_chunk,
    mark_blocks,
    prefetch_slice,
    reset_transmittance,
    set_tile_frame,
    set_tile_pixels,
)
from pansplat.rendering.cpu.records import TILE_SIZE, tabulate_pixels
from pansplat.rendering.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    copy_four,
    lane_sums,
    load,
    load_broadcast,
    load_scalar,
    multiply_add,
    popcount,
    store,
    store_scalar,
)
from pansplat.rendering.cpu.tiling import (
    TileIntersections,
    find_bounding_boxes,
    intersect_tiles,
    parallel_for_tiles,
    sort_front_to_back,
)
from pansplat.rendering.cpu.view import make_camera
from pansplat.rendering.image_planes import image_planes
from pansplat.system.kernels import (
    Workspace,
    inline_kernel_no_refcount,
    kernel,
    pooled_empty,
    thread_count,
)

MAX_BAND_INTERSECTIONS = 1 << 18  # intersections in a band: up to 10 million pairs, which take 0.3 GB
MAX_STORED_PAIRS = 1 << 24  # pairs whose weights are kept, which take 0.6 GB


class _Pairs(NamedTuple):
    """Weights of a band of tiles.

    Attributes:
        starts: (tile), first pair of each tile.
        rows: (tile + 1), first row of `counts` of each tile.
        num_chunks: (tile), chunks that were composited before all of the tile's pixels were finished.
        counts: (chunk, NUM_BLOCKS), pairs of each block.
        weights: (LANES pair), of the block's pixels.
        members: (pair), index of the Gaussian in its chunk.
        workspace: memory of counts, weights and members.
    """

    starts: np.ndarray
    rows: np.ndarray
    num_chunks: np.ndarray
    counts: np.ndarray
    weights: np.ndarray
    members: np.ndarray
    workspace: Workspace


class StoredWeights:
    """The weights of Gaussians in a panorama, by the exact kernel, in float32.

    Args:
        gaussians: float32, in main memory; their harmonics are not used.
        cam2world: pose of the camera.
        size: height and width of the panorama, pixels.
    """

    def __init__(self, gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], size: tuple[int, int]) -> None:
        self._size, self._count, self._threads = size, len(gaussians), thread_count()
        (plane,) = image_planes("equirect", size)
        fields = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.harmonics
        tensors = tuple(field.detach().contiguous() for field in fields)
        arrays, camera = GaussianArrays.from_tensors(tensors), make_camera(cam2world.double(), plane, NEAR)
        self._workspace, self._tables = Workspace(), tabulate_pixels(plane)
        projected = project_gaussians(arrays, camera, self._workspace, self._threads)
        boxes = find_bounding_boxes(projected.records, plane, self._workspace, self._threads)
        self._scene = projected.records.reshape(-1), projected.values
        self._bands = list(
            intersect_tiles(boxes, size, slots=True, threads=self._threads, limit=MAX_BAND_INTERSECTIONS)
        )
        for tiles in self._bands:
            sort_front_to_back(tiles, projected.radii, self._threads)
        self._stored: dict[int, _Pairs] = {}
        self._free = MAX_STORED_PAIRS

    def _iterate_bands(self) -> Iterator[tuple[TileIntersections, _Pairs]]:
        """All bands with their pairs, which are computed again if they are too many to be stored."""
        for tiles in self._bands:
            pairs = self._stored.get(tiles.first_row)
            if pairs is None:
                pairs = _allocate_pairs(tiles, self._threads)
                scene = *self._scene, tiles.intersections.reshape(-1), tiles.starts
                arguments = *scene, *self._tables, *pairs[:-1], tiles.first_row
                parallel_for_tiles(_compute_weights, arguments, tiles.starts, self._threads)
                if len(pairs.members) <= self._free:
                    self._stored[tiles.first_row] = pairs
                    self._free -= len(pairs.members)
            yield tiles, pairs

    def blend(self, values: Float[Tensor, "n channel"]) -> Float[Tensor, "channel height width"]:
        """See `pansplat.rendering.weights.BlendingWeights`."""
        padded = np.zeros((self._count, VALUE_LANES), np.float32)
        padded[:, : values.shape[1]] = values.numpy()
        image = pooled_empty((VALUE_LANES, *self._size), np.float32)
        for tiles, pairs in self._iterate_bands():
            arguments = padded, tiles.intersections.reshape(-1), tiles.starts, *pairs[:-1], image, tiles.first_row
            parallel_for_tiles(_blend, arguments, tiles.starts, self._threads)
        return torch.from_numpy(image)[: values.shape[1]]

    def accumulate(self, image: Float[Tensor, "channel height width"]) -> Float[Tensor, "n channel"]:
        """See `pansplat.rendering.weights.BlendingWeights`."""
        padded = np.zeros((VALUE_LANES, *self._size), np.float32)
        padded[: len(image)] = image.numpy()
        totals = np.zeros((self._count, VALUE_LANES), np.float32)
        for tiles, pairs in self._iterate_bands():
            slots = pooled_empty((len(tiles.intersections), VALUE_LANES), np.float32)
            arguments = tiles.starts, tiles.slots, *pairs[:-1], padded, slots.reshape(-1), tiles.first_row
            parallel_for_tiles(_accumulate, arguments, tiles.starts, self._threads)
            accumulate_slots(tiles.offsets, slots, totals, self._threads)
        return torch.from_numpy(totals)[:, : len(image)]


def _allocate_pairs(tiles: TileIntersections, threads: int) -> _Pairs:
    """Allocate memory for the pairs of all Gaussians whose boxes reach a block; pages that stay empty cost nothing."""
    num_chunks = -(-np.diff(tiles.starts) // CHUNK_SIZE)
    rows = np.concatenate((np.zeros(1, np.int64), np.cumsum(num_chunks)))
    candidates = np.zeros(len(num_chunks), np.int64)
    parallel_for_tiles(
        _count_candidates, (tiles.intersections.reshape(-1), tiles.starts, candidates), tiles.starts, threads
    )
    ends, workspace = np.cumsum(candidates), Workspace()
    size = int(ends[-1]) + 1  # the kernel writes one pair past the last one
    return _Pairs(
        ends - candidates,
        rows,
        np.zeros(len(num_chunks), np.int64),
        workspace.array((int(rows[-1]), NUM_BLOCKS), np.int32),
        workspace.array(LANES * size, np.float32),
        workspace.array(size, np.uint8),
        workspace,
    )


@kernel
def _count_candidates(intersections, starts, candidates, low, high):
    """Count the pairs of each tile, visible or not, and one more."""
    masks = np.empty(CHUNK_WORDS * NUM_MASKS, np.uint64)
    for tile in range(low, high):
        total = np.int64(1)
        for first in range(starts[tile], starts[tile + 1], CHUNK_SIZE):
            mark_blocks(intersections, first, min(CHUNK_SIZE, starts[tile + 1] - first), masks)
            for block in range(NUM_BLOCKS):
                column, row = block % BLOCKS_ACROSS, ROW_MASKS + block // BLOCKS_ACROSS
                for word in range(0, CHUNK_WORDS * NUM_MASKS, NUM_MASKS):
                    total += popcount(load_scalar(masks, word + column) & load_scalar(masks, word + row))
        candidates[tile] = total


@kernel
def _compute_weights(
    records, values, intersections, starts, kind, columns, rows, rotation, pair_starts, chunk_rows, num_chunks, counts,
    weights, members, first_row, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE_SIZE - 1) // TILE_SIZE
    offsets, centre = np.empty(3 * TILE_PIXELS, np.float32), np.empty(3)
    frame, transmittance = np.empty(TILE_FRAME_SIZE, np.float32), np.empty(TILE_PIXELS, np.float32)
    footprints = np.empty(FOOTPRINT_SIZE * CHUNK_SIZE, np.float32)
    chunk_values = np.empty(values.shape[1] * CHUNK_SIZE, np.float32)
    masks = np.empty(CHUNK_WORDS * NUM_MASKS, np.uint64)
    log2_alphas, indices = np.empty(BUFFER_SIZE * LANES, np.float32), np.empty(BUFFER_SIZE, np.uint8)
    cut = broadcast(np.float32(MIN_TRANSMITTANCE))
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        tile_is_3d, pixels_are_3d = set_tile_frame(kind, columns, rows, rotation, left, top, centre, frame), -1
        reset_transmittance(columns, rows, left, top, transmittance)
        chunk, pair = chunk_rows[tile], pair_starts[tile]
        for first in range(starts[tile], starts[tile + 1], CHUNK_SIZE):
            count = min(CHUNK_SIZE, starts[tile + 1] - first)
            is_3d = load_chunk(
                records, values, intersections, first, count, frame, tile_is_3d, footprints, chunk_values
            )
            if pixels_are_3d != is_3d:
                set_tile_pixels(kind, columns, rows, rotation, left, top, centre, frame, is_3d, offsets)
                pixels_are_3d = np.int64(is_3d)
            mark_blocks(intersections, first, count, masks)
            is_unfinished = False
            for block in range(NUM_BLOCKS):
                prefetch_slice(records, values, intersections, block, first + CHUNK_SIZE)
                counts[chunk, block] = 0
                transmitted = load(transmittance, block * LANES)
                if not any_lane(transmitted > cut):
                    continue
                num = compute_log2_alphas(block, masks, is_3d, footprints, offsets, log2_alphas, indices, 0)
                begin = pair
                for at in range(num):
                    alpha = compute_alpha(load(log2_alphas, at * LANES))
                    store(weights, pair * LANES, alpha * transmitted)
                    store_scalar(members, pair, load_scalar(indices, at))
                    transmitted = multiply_add(-alpha, transmitted, transmitted)
                    # The next Gaussian overwrites this one if no pixel sees it.
                    pair += np.int64(any_lane(alpha > broadcast(np.float32(0))))
                counts[chunk, block] = pair - begin
                store(transmittance, block * LANES, transmitted)
                is_unfinished |= any_lane(transmitted > cut)
            chunk += 1
            if not is_unfinished:
                break
        num_chunks[tile] = chunk - chunk_rows[tile]


@kernel
def _blend(
    values, intersections, starts, pair_starts, chunk_rows, num_chunks, counts, weights, members, image, first_row,
    low, high,
):  # fmt: skip
    height, width = image.shape[1], image.shape[2]
    tiles_across = (width + TILE_SIZE - 1) // TILE_SIZE
    chunk_values = np.empty(VALUE_LANES * CHUNK_SIZE, np.float32)
    sums = np.empty(VALUE_LANES * TILE_PIXELS, np.float32)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        sums[:] = 0
        pair = pair_starts[tile]
        for chunk in range(num_chunks[tile]):
            first = starts[tile] + chunk * CHUNK_SIZE
            for s in range(min(CHUNK_SIZE, starts[tile + 1] - first)):
                g = np.int64(load_scalar(intersections, 2 * (first + s)))
                copy_four(chunk_values, VALUE_LANES * s, values, VALUE_LANES * g)
            for block in range(NUM_BLOCKS):
                num = counts[chunk_rows[tile] + chunk, block]
                _blend_block(block * LANES, pair, num, weights, members, chunk_values, sums)
                pair += num
        for pixel in range(TILE_PIXELS):
            x, y = image_position(pixel, left, top)
            if x < width and y < height:
                for value in range(VALUE_LANES):
                    image[value, y, x] = sums[value * TILE_PIXELS + pixel]


@inline_kernel_no_refcount
def _blend_block(pixel, pair, num, weights, members, chunk_values, sums):
    """Add the values of a block's Gaussians to its sums."""
    sum0, sum1 = load(sums, pixel), load(sums, TILE_PIXELS + pixel)
    sum2, sum3 = load(sums, 2 * TILE_PIXELS + pixel), load(sums, 3 * TILE_PIXELS + pixel)
    for at in range(pair, pair + num):
        weight, first = load(weights, at * LANES), VALUE_LANES * np.int64(load_scalar(members, at))
        sum0 = multiply_add(weight, load_broadcast(chunk_values, first), sum0)
        sum1 = multiply_add(weight, load_broadcast(chunk_values, first + 1), sum1)
        sum2 = multiply_add(weight, load_broadcast(chunk_values, first + 2), sum2)
        sum3 = multiply_add(weight, load_broadcast(chunk_values, first + 3), sum3)
    store(sums, pixel, sum0)
    store(sums, TILE_PIXELS + pixel, sum1)
    store(sums, 2 * TILE_PIXELS + pixel, sum2)
    store(sums, 3 * TILE_PIXELS + pixel, sum3)


@kernel
def _accumulate(
    starts, slots, pair_starts, chunk_rows, num_chunks, counts, weights, members, image, totals, first_row, low, high
):  # fmt: skip
    height, width = image.shape[1], image.shape[2]
    tiles_across = (width + TILE_SIZE - 1) // TILE_SIZE
    pixels = np.empty(VALUE_LANES * TILE_PIXELS, np.float32)
    sums, two_rows = np.empty((CHUNK_SIZE + 1) * VALUE_LANES * LANES, np.float32), np.empty(LANES, np.float32)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        for pixel in range(TILE_PIXELS):
            x, y = image_position(pixel, left, top)
            for value in range(VALUE_LANES):
                is_inside = x < width and y < height
                pixels[value * TILE_PIXELS + pixel] = image[value, y, x] if is_inside else np.float32(0)
        pair = pair_starts[tile]
        for chunk in range(num_chunks[tile]):
            first = starts[tile] + chunk * CHUNK_SIZE
            count = min(CHUNK_SIZE, starts[tile + 1] - first)
            sums[: (count + 1) * VALUE_LANES * LANES] = 0
            for block in range(NUM_BLOCKS):
                num = counts[chunk_rows[tile] + chunk, block]
                _accumulate_block(block * LANES, pair, num, weights, members, pixels, sums)
                pair += num
            for s in range(0, count, 2):
                row = s * VALUE_LANES * LANES
                store(two_rows, 0, lane_sums(
                    load(sums, row), load(sums, row + LANES), load(sums, row + 2 * LANES), load(sums, row + 3 * LANES),
                    load(sums, row + 4 * LANES), load(sums, row + 5 * LANES), load(sums, row + 6 * LANES),
                    load(sums, row + 7 * LANES),
                ))  # fmt: skip
                copy_four(totals, VALUE_LANES * slots[first + s], two_rows, 0)
                if s + 1 < count:
                    copy_four(totals, VALUE_LANES * slots[first + s + 1], two_rows, VALUE_LANES)
        for e in range(starts[tile] + CHUNK_SIZE * num_chunks[tile], starts[tile + 1]):
            for value in range(VALUE_LANES):
                store_scalar(totals, VALUE_LANES * slots[e] + value, np.float32(0))


@inline_kernel_no_refcount
def _accumulate_block(pixel, pair, num, weights, members, pixels, sums):
    """Add weight times image to the sums of a block's Gaussians, a vector for each value."""
    x0, x1 = load(pixels, pixel), load(pixels, TILE_PIXELS + pixel)
    x2, x3 = load(pixels, 2 * TILE_PIXELS + pixel), load(pixels, 3 * TILE_PIXELS + pixel)
    for at in range(pair, pair + num):
        weight, row = load(weights, at * LANES), VALUE_LANES * LANES * np.int64(load_scalar(members, at))
        store(sums, row, multiply_add(weight, x0, load(sums, row)))
        store(sums, row + LANES, multiply_add(weight, x1, load(sums, row + LANES)))
        store(sums, row + 2 * LANES, multiply_add(weight, x2, load(sums, row + 2 * LANES)))
        store(sums, row + 3 * LANES, multiply_add(weight, x3, load(sums, row + 3 * LANES)))
