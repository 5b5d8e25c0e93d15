"""Stage three: footprints composited tile by tile, front to back.

Source: docs/rendering.md, section 4. A tile is rasterised in chunks of Gaussians. For each chunk the Gaussians that
reach each block of 4 x 2 pixels, one SIMD vector, are listed as bits. Then each block composites its list with the
transmittance and the sums in registers. The inner loops have no branches to mispredict.

The length of a ray is arbitrary. So a tile places its pixels and Gaussians where their rays meet the plane that touches
the sphere at the tile's centre, and footprint rows have two components. If a Gaussian or a pixel is too far from the
centre for that plane, footprint rows have three components ("3d" below).

The footprints of a chunk are a structure of arrays (`FOOTPRINT_SIZE` x `CHUNK_SIZE`) that fits the L1 cache: setup
computes eight Gaussians at once, and compositing broadcasts one number to eight pixels.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pansplat.constants import ALPHA_CUT, MAX_ALPHA, TRANSMITTANCE_CUT
from pansplat.rendering.cpu.projection import dot, tangent_frame
from pansplat.rendering.cpu.records import BLOCK_WIDTH, COLUMN_RAYS, EQUIRECT_RAYS, RECORD_SIZE, TILE_SIZE, PixelTables
from pansplat.rendering.cpu.simd import (
    LANES,
    any_lane,
    broadcast,
    copy_four,
    exp2,
    list_set_bits,
    load,
    load_broadcast,
    load_scalar,
    load_transposed,
    multiply_add,
    popcount,
    prefetch,
    select,
    store,
    store_scalar,
)
from pansplat.rendering.cpu.tiling import parallel_for_tiles
from pansplat.system.kernels import Workspace, inline_kernel_no_refcount, kernel

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]

BLOCK_HEIGHT = LANES // BLOCK_WIDTH
BLOCKS_ACROSS = TILE_SIZE // BLOCK_WIDTH
BLOCKS_DOWN = TILE_SIZE // BLOCK_HEIGHT
NUM_BLOCKS = BLOCKS_ACROSS * BLOCKS_DOWN
TILE_PIXELS = TILE_SIZE * TILE_SIZE
CHUNK_SIZE = 256  # Gaussians that are marked and composited together
CHUNK_WORDS = CHUNK_SIZE // 64  # a word has 64 bits, one per Gaussian
ROW_MASKS = BLOCKS_ACROSS + 1  # index of the first row's mask, after the columns; see `mark_blocks`
NUM_MASKS = ROW_MASKS + BLOCKS_DOWN + 1  # per word of a chunk
BUFFER_SIZE = CHUNK_SIZE + 64  # log2 alphas of a block, and up to 64 bytes that `list_set_bits` overwrites
_SLICE_SIZE = CHUNK_SIZE // NUM_BLOCKS  # Gaussians of the next chunk that each block prefetches

# Rows of a chunk's footprints.
ROW_A, ROW_B, ROW_L = 0, 2, 4  # first rows of a, b and l, which have two components each
POINT = 6  # first row of the Gaussian's point, which has two components
RADIAL_VARIANCE, LOG2_PEAK = 8, 9
THIRD = 10  # third components of a, b, l and the point; only used in 3d
FOOTPRINT_SIZE = 14

LOG2_ALPHA_CUT = math.log2(ALPHA_CUT)
LOG2_ZERO = -1000.0  # log2 of an alpha that counts as zero
MIN_TRANSMITTANCE = TRANSMITTANCE_CUT["numba"]  # a pixel is finished at this transmittance or below
MIN_PLANAR_COSINE = 0.5  # cosine of the angle to the tile's centre, below which footprint rows have three components
_HORIZON_MARGIN = 0.1  # log2 alpha by which the test at the horizon is widened
VALUE_LANES = 4  # values of a Gaussian: RGB and the distance
TILE_FRAME_SIZE = 15  # see `set_tile_frame`


@inline_kernel_no_refcount
def image_position(pixel, left, top):
    """Column and row in the image of a tile's pixel; a tile numbers its pixels block by block."""
    block, lane = pixel // LANES, pixel % LANES
    return (
        left + (block % BLOCKS_ACROSS) * BLOCK_WIDTH + lane % BLOCK_WIDTH,
        top + (block // BLOCKS_ACROSS) * BLOCK_HEIGHT + lane // BLOCK_WIDTH,
    )


@inline_kernel_no_refcount
def pixel_point(kind, columns, rows, rotation, x, y):
    """The unit direction of pixel (x, y)."""
    if kind == EQUIRECT_RAYS:
        cosine = rows[y, 1]
        return cosine * columns[x, 0], rows[y, 0], cosine * columns[x, 1]
    if kind == COLUMN_RAYS:
        row = 2 * (x % BLOCK_WIDTH)
        cosine = rows[y, row + 1]
        return cosine * columns[x, 0], rows[y, row], cosine * columns[x, 1]
    right, down = columns[x, 0], rows[y, 0]
    scale = 1 / math.sqrt(right * right + down * down + 1)
    right, down = right * scale, down * scale
    return (
        rotation[0, 0] * right + rotation[0, 1] * down + rotation[0, 2] * scale,
        rotation[1, 0] * right + rotation[1, 1] * down + rotation[1, 2] * scale,
        rotation[2, 0] * right + rotation[2, 1] * down + rotation[2, 2] * scale,
    )


@inline_kernel_no_refcount
def set_tile_frame(kind, columns, rows, rotation, left, top, centre, frame):
    """Set a tile's centre and axes.

    Args:
        kind, columns, rows, rotation: fields of the PixelTables.
        left, top: pixel at the tile's corner.
        centre: (3) float64, written.
        frame: (TILE_FRAME_SIZE), written: the centre as float32, its residual, two axes across, and the centre again as
            the third axis.

    Returns:
        Whether a pixel is too far from the centre for footprint rows with two components.
    """
    min_cosine = 1.0  # cosine of the angle from the centre to the farthest pixel, which is in a corner
    for corner in range(-1, 4):
        x, y = left + TILE_SIZE // 2, top + TILE_SIZE // 2
        if corner >= 0:
            x, y = left + corner % 2 * (TILE_SIZE - 1), top + corner // 2 * (TILE_SIZE - 1)
        x, y = min(x, len(columns) - 1), min(y, len(rows) - 1)
        d_x, d_y, d_z = pixel_point(kind, columns, rows, rotation, x, y)
        if corner < 0:
            centre[0], centre[1], centre[2] = d_x, d_y, d_z
        else:
            min_cosine = min(min_cosine, dot(centre[0], centre[1], centre[2], d_x, d_y, d_z))
    axes = tangent_frame(centre[0], centre[1], centre[2])
    for axis in range(3):
        frame[axis] = np.float32(centre[axis])
        frame[3 + axis] = np.float32(centre[axis] - np.float64(frame[axis]))
        frame[12 + axis] = np.float32(centre[axis])
    for axis in range(6):
        frame[6 + axis] = np.float32(axes[axis])
    return min_cosine < MIN_PLANAR_COSINE


@inline_kernel_no_refcount
def set_tile_pixels(kind, columns, rows, rotation, left, top, centre, frame, is_3d, offsets):
    """Compute the offsets of a tile's pixels from its centre, block by block.

    Args:
        kind, columns, rows, rotation, left, top, centre, frame: as in `set_tile_frame`.
        is_3d: offsets along all three axes; otherwise on the plane that touches the sphere at the centre.
        offsets: (3 TILE_PIXELS), written.
    """
    width, height = len(columns), len(rows)
    for pixel in range(TILE_PIXELS):
        x, y = image_position(pixel, left, top)
        d_x, d_y, d_z = pixel_point(kind, columns, rows, rotation, min(x, width - 1), min(y, height - 1))
        d_x, d_y, d_z = d_x - centre[0], d_y - centre[1], d_z - centre[2]
        ahead = frame[12] * d_x + frame[13] * d_y + frame[14] * d_z
        scale = 1.0 if is_3d else 1 / (1 + ahead)
        offsets[pixel] = np.float32((frame[6] * d_x + frame[7] * d_y + frame[8] * d_z) * scale)
        offsets[TILE_PIXELS + pixel] = np.float32((frame[9] * d_x + frame[10] * d_y + frame[11] * d_z) * scale)
        offsets[2 * TILE_PIXELS + pixel] = np.float32(ahead)


@inline_kernel_no_refcount
def reset_transmittance(columns, rows, left, top, transmittance):
    """Set the transmittance to 1; to 0 for pixels outside the image, so that they count as finished."""
    width, height = len(columns), len(rows)
    for pixel in range(TILE_PIXELS):
        x, y = image_position(pixel, left, top)
        transmittance[pixel] = np.float32(1 if x < width and y < height else 0)


@inline_kernel_no_refcount
def prefetch_slice(records, values, intersections, block, first):
    """Prefetch this block's slice of the chunk that begins at intersection `first`."""
    end = len(intersections) // 2 - 1
    for e in range(first + block * _SLICE_SIZE, first + (block + 1) * _SLICE_SIZE):
        index = np.int64(load_scalar(intersections, 2 * max(min(e, end), 0)))
        prefetch(records, RECORD_SIZE * index)
        prefetch(values, VALUE_LANES * index)


@inline_kernel_no_refcount
def load_eight_records(records, intersections, e, last):
    """The columns of eight records, in two groups of eight.

    Args:
        e: first intersection.
        last: last intersection, repeated past the end.
    """
    r0 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * e))
    r1 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 1, last)))
    r2 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 2, last)))
    r3 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 3, last)))
    r4 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 4, last)))
    r5 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 5, last)))
    r6 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 6, last)))
    r7 = RECORD_SIZE * np.int64(load_scalar(intersections, 2 * min(e + 7, last)))
    return (
        load_transposed(records, r0, r1, r2, r3, r4, r5, r6, r7),
        load_transposed(records, r0 + 8, r1 + 8, r2 + 8, r3 + 8, r4 + 8, r5 + 8, r6 + 8, r7 + 8),
    )


@inline_kernel_no_refcount
def load_chunk(records, values, intersections, first, count, frame, is_3d, footprints, chunk_values):
    """Compute the footprints and copy the values of a chunk.

    Args:
        records, intersections: flat.
        values: (n, VALUE_LANES).
        first, count: the chunk's intersections.
        frame: frame of the tile.
        is_3d: whether the tile needs three components.
        footprints: (FOOTPRINT_SIZE CHUNK_SIZE), written; past `count` the last Gaussian is repeated.
        chunk_values: (CHUNK_SIZE VALUE_LANES), written.

    Returns:
        Whether the footprints have three components, because a Gaussian is too far from the tile's centre for two.
    """
    while _compute_footprints(records, intersections, first, count, frame, is_3d, footprints):
        is_3d = True
    for s in range(count):
        g = np.int64(load_scalar(intersections, 2 * (first + s)))
        copy_four(chunk_values, VALUE_LANES * s, values, VALUE_LANES * g)
    return is_3d


@inline_kernel_no_refcount
def _compute_footprints(records, intersections, first, count, frame, is_3d, footprints):
    """Compute a chunk's footprints; return whether they must be computed again in 3d."""
    last = first + count - 1
    one = broadcast(np.float32(1))
    min_ahead, max_horizon = one, broadcast(np.float32(0))
    for at in range(0, count, LANES):
        low, high = load_eight_records(records, intersections, first + at, last)
        n_x, n_y, n_z, residual_x, residual_y, residual_z, a_x, a_y = low
        a_z, b_x, b_y, b_z, l_along_a, l_along_b, radial_variance, log2_peak = high
        m_x = (n_x - broadcast(frame[0])) + (residual_x - broadcast(frame[3]))
        m_y = (n_y - broadcast(frame[1])) + (residual_y - broadcast(frame[4]))
        m_z = (n_z - broadcast(frame[2])) + (residual_z - broadcast(frame[5]))
        m_x, m_y, m_z = _to_tile_frame(frame, m_x, m_y, m_z)
        a_x, a_y, a_z = _to_tile_frame(frame, a_x, a_y, a_z)
        b_x, b_y, b_z = _to_tile_frame(frame, b_x, b_y, b_z)
        l_x = multiply_add(l_along_a, a_x, multiply_add(l_along_b, b_x, m_x))
        l_y = multiply_add(l_along_a, a_y, multiply_add(l_along_b, b_y, m_y))
        ahead = one + m_z
        if is_3d:
            l_z = multiply_add(l_along_a, a_z, multiply_add(l_along_b, b_z, ahead))
            store(footprints, THIRD * CHUNK_SIZE + at, a_z)
            store(footprints, (THIRD + 1) * CHUNK_SIZE + at, b_z)
            store(footprints, (THIRD + 2) * CHUNK_SIZE + at, l_z)
            store(footprints, (THIRD + 3) * CHUNK_SIZE + at, m_z)
            ahead = one
        # If this is below 1, no pixel beyond the horizon, where L < 0, reaches the alpha cut: log2 alpha is at most
        # log2_peak - 1 / radial_variance there.
        horizon = radial_variance * (log2_peak + broadcast(np.float32(_HORIZON_MARGIN - LOG2_ALPHA_CUT)))
        min_ahead, inverse = min(min_ahead, ahead), one / ahead
        max_horizon = max(max_horizon, horizon)
        store(footprints, ROW_A * CHUNK_SIZE + at, ahead * a_x)
        store(footprints, (ROW_A + 1) * CHUNK_SIZE + at, ahead * a_y)
        store(footprints, ROW_B * CHUNK_SIZE + at, ahead * b_x)
        store(footprints, (ROW_B + 1) * CHUNK_SIZE + at, ahead * b_y)
        store(footprints, ROW_L * CHUNK_SIZE + at, ahead * l_x)
        store(footprints, (ROW_L + 1) * CHUNK_SIZE + at, ahead * l_y)
        store(footprints, POINT * CHUNK_SIZE + at, inverse * m_x)
        store(footprints, (POINT + 1) * CHUNK_SIZE + at, inverse * m_y)
        store(footprints, RADIAL_VARIANCE * CHUNK_SIZE + at, radial_variance)
        store(footprints, LOG2_PEAK * CHUNK_SIZE + at, log2_peak)
    is_far = any_lane(broadcast(np.float32(MIN_PLANAR_COSINE)) > min_ahead)
    return not is_3d and (is_far or any_lane(max_horizon > one))


@inline_kernel_no_refcount
def _to_tile_frame(frame, x, y, z):
    """Components of vectors along a tile's three axes."""
    return (
        multiply_add(broadcast(frame[6]), x, multiply_add(broadcast(frame[7]), y, broadcast(frame[8]) * z)),
        multiply_add(broadcast(frame[9]), x, multiply_add(broadcast(frame[10]), y, broadcast(frame[11]) * z)),
        multiply_add(broadcast(frame[12]), x, multiply_add(broadcast(frame[13]), y, broadcast(frame[14]) * z)),
    )


@inline_kernel_no_refcount
def mark_blocks(intersections, first, count, masks):
    """Set the bits of the Gaussians that reach each column and each row of blocks; those of a block are in both.

    Args:
        intersections: flat.
        first: intersection of bit 0.
        masks: (CHUNK_WORDS NUM_MASKS) uint64, written: for each word BLOCKS_ACROSS columns and a spare one, then
            BLOCKS_DOWN rows and a spare one.
    """
    masks[:] = 0
    for at in range(count):
        box = load_scalar(intersections, 2 * (first + at) + 1)
        bit, word = np.uint64(1) << np.uint64(at & 63), (at >> 6) * NUM_MASKS
        _toggle(masks, word + (box & 255) // BLOCK_WIDTH, bit)
        _toggle(masks, word + ((box >> 8) & 255) // BLOCK_WIDTH + 1, bit)
        _toggle(masks, word + ROW_MASKS + ((box >> 16) & 255) // BLOCK_HEIGHT, bit)
        _toggle(masks, word + ROW_MASKS + ((box >> 24) & 255) // BLOCK_HEIGHT + 1, bit)
    # Bits were toggled where a box begins and after its end; a running XOR sets them in between.
    for word in range(0, (count + 63) // 64 * NUM_MASKS, NUM_MASKS):
        for mask in range(word + 1, word + BLOCKS_ACROSS):
            _toggle(masks, mask, load_scalar(masks, mask - 1))
        for mask in range(word + ROW_MASKS + 1, word + ROW_MASKS + BLOCKS_DOWN):
            _toggle(masks, mask, load_scalar(masks, mask - 1))


@inline_kernel_no_refcount
def _toggle(words, index, bits):
    store_scalar(words, index, load_scalar(words, index) ^ bits)


class SavedForBackward(NamedTuple):
    """Transmittances that the forward saves for the backward.

    Attributes:
        transmittance: (row, TILE_PIXELS) float32, before each chunk that was composited.
        rows: (tile + 1), first row of each tile.
        num_chunks: (tile), chunks that were composited before all of the tile's pixels were finished.
    """

    transmittance: Floats
    rows: Longs
    num_chunks: Longs


def allocate_saved(starts: Longs, workspace: Workspace) -> SavedForBackward:
    """Allocate the memory of `SavedForBackward` for these tiles."""
    num_chunks = -(-np.diff(starts) // CHUNK_SIZE)
    rows = np.concatenate((np.zeros(1, np.int64), np.cumsum(num_chunks)))
    transmittance = workspace.array((int(rows[-1]), TILE_PIXELS), np.float32)
    return SavedForBackward(transmittance, rows, np.zeros(len(num_chunks), np.int64))


def rasterize_forward(
    records: Floats,
    values: Floats,
    intersections: Integers,
    starts: Longs,
    tables: PixelTables,
    sums: Floats,
    *,
    first_row: int = 0,
    saved: SavedForBackward | None = None,
    threads: int = 1,
    min_transmittance: float = MIN_TRANSMITTANCE,
) -> None:
    """Write the sums of weight x (values, 1) over a band of tile rows.

    Args:
        records, values, intersections, starts: see records.py; `starts` covers whole rows of tiles.
        sums: (VALUE_LANES + 1, height, width), written within the band.
        first_row: first row of tiles of the band.
        saved: written, if given, for the backward.
        min_transmittance: a pixel is finished at this transmittance or below.
    """
    saved = saved or SavedForBackward(np.empty((0, TILE_PIXELS), np.float32), starts, starts)
    scene = records.reshape(-1), values, intersections.reshape(-1), starts
    parallel_for_tiles(
        _rasterize_tiles, (*scene, *tables, sums, *saved, first_row, np.float32(min_transmittance)), starts, threads
    )


@kernel
def _rasterize_tiles(
    records, values, intersections, starts, kind, columns, rows, rotation, sums, saved_transmittance, saved_rows,
    saved_num_chunks, first_row, min_transmittance, low, high,
):  # fmt: skip
    tiles_across = (len(columns) + TILE_SIZE - 1) // TILE_SIZE
    offsets, centre = np.empty(3 * TILE_PIXELS, np.float32), np.empty(3)
    frame = np.empty(TILE_FRAME_SIZE, np.float32)
    transmittance, tile_sums = np.empty(TILE_PIXELS, np.float32), np.empty(VALUE_LANES * TILE_PIXELS, np.float32)
    footprints = np.empty(FOOTPRINT_SIZE * CHUNK_SIZE, np.float32)
    chunk_values = np.empty(VALUE_LANES * CHUNK_SIZE, np.float32)
    masks = np.empty(CHUNK_WORDS * NUM_MASKS, np.uint64)
    log2_alphas, indices = np.empty(2 * BUFFER_SIZE * LANES, np.float32), np.empty(2 * BUFFER_SIZE, np.uint8)
    for tile in range(low, high):
        left, top = (tile % tiles_across) * TILE_SIZE, (first_row + tile // tiles_across) * TILE_SIZE
        tile_is_3d, pixels_are_3d = set_tile_frame(kind, columns, rows, rotation, left, top, centre, frame), -1
        reset_transmittance(columns, rows, left, top, transmittance)
        tile_sums[:] = 0
        num_chunks = 0
        for first in range(starts[tile], starts[tile + 1], CHUNK_SIZE):
            count = min(CHUNK_SIZE, starts[tile + 1] - first)
            if len(saved_transmittance) > 0:
                _save_transmittance(transmittance, saved_transmittance, saved_rows[tile] + num_chunks)
            num_chunks += 1
            is_3d = load_chunk(
                records, values, intersections, first, count, frame, tile_is_3d, footprints, chunk_values
            )
            if pixels_are_3d != is_3d:
                set_tile_pixels(kind, columns, rows, rotation, left, top, centre, frame, is_3d, offsets)
                pixels_are_3d = np.int64(is_3d)
            mark_blocks(intersections, first, count, masks)
            is_unfinished = False
            # The alphas of one block are computed before those of the previous block are composited (software
            # pipelining), so that the latencies of both overlap. Two halves of the buffers alternate.
            ready, num_ready, num_next, begin = -1, 0, 0, 0
            for block in range(NUM_BLOCKS + 1):
                if block < NUM_BLOCKS:
                    prefetch_slice(records, values, intersections, block, first + CHUNK_SIZE)
                    if not any_lane(load(transmittance, block * LANES) > broadcast(min_transmittance)):
                        continue
                    num_next = compute_log2_alphas(
                        block, masks, is_3d, footprints, offsets, log2_alphas, indices, begin
                    )
                other = BUFFER_SIZE - begin
                if ready >= 0:
                    is_unfinished |= _blend_values(
                        ready, num_ready, log2_alphas, indices, other, chunk_values, transmittance, tile_sums,
                        min_transmittance,
                    )  # fmt: skip
                ready, num_ready, begin = block, num_next, other
            if not is_unfinished:
                break
        if len(saved_transmittance) > 0:
            saved_num_chunks[tile] = num_chunks
        _write_tile(transmittance, tile_sums, sums, left, top)


@inline_kernel_no_refcount
def _save_transmittance(transmittance, saved_transmittance, row):
    for pixel in range(TILE_PIXELS):
        saved_transmittance[row, pixel] = transmittance[pixel]


@inline_kernel_no_refcount
def compute_log2_alphas(block, masks, is_3d, footprints, offsets, log2_alphas, indices, begin):
    """Compute log2 alpha, before cut and clamp, of the Gaussians that reach a block, front to back.

    Args:
        log2_alphas, indices: written from `begin` on, LANES and one number per Gaussian; indices are within the chunk.

    Returns:
        The number of Gaussians. One with alpha 0 follows them. Gaussians with alpha 0 in the whole block are included:
        if they were skipped, each step of the loop would depend on the previous one.
    """
    pixel = block * LANES
    x, y, z = load(offsets, pixel), load(offsets, TILE_PIXELS + pixel), load(offsets, 2 * TILE_PIXELS + pixel)
    total = _list_gaussians(block, masks, indices, begin)
    zero = broadcast(np.float32(0))
    for at in range(begin, begin + total):
        s = np.int64(load_scalar(indices, at))
        a, b, front = evaluate_footprint(is_3d, footprints, s, x, y, z)
        if is_3d:
            front = select(front > zero, front, broadcast(np.float32(np.nan)))
        q = multiply_add(a, a, b * b)
        radial_variance = load_broadcast(footprints, RADIAL_VARIANCE * CHUNK_SIZE + s)
        divisor = multiply_add(max(zero, front), front, radial_variance * q)
        store(log2_alphas, at * LANES, load_broadcast(footprints, LOG2_PEAK * CHUNK_SIZE + s) - q / divisor)
    store(log2_alphas, (begin + total) * LANES, broadcast(np.float32(LOG2_ZERO)))
    return total


@inline_kernel_no_refcount
def _list_gaussians(block, masks, indices, begin):
    """Write the chunk indices of the Gaussians that reach a block, and a 0 after them; return their number."""
    at, column, row = begin, block % BLOCKS_ACROSS, ROW_MASKS + block // BLOCKS_ACROSS
    for word in range(CHUNK_WORDS):
        bits = load_scalar(masks, word * NUM_MASKS + column) & load_scalar(masks, word * NUM_MASKS + row)
        list_set_bits(indices, at, bits, word * 64)
        at += popcount(bits)
    store_scalar(indices, at, np.uint8(0))
    return at - begin


@inline_kernel_no_refcount
def evaluate_footprint(is_3d, footprints, s, x, y, z):
    """A, B and L of Gaussian `s` of the chunk at a block's pixels, up to a factor per pixel that cancels in Q / L^2.

    Offsets are relative to the Gaussian first: they are small, so the sums have no cancellation.
    """
    x = x - load_broadcast(footprints, POINT * CHUNK_SIZE + s)
    y = y - load_broadcast(footprints, (POINT + 1) * CHUNK_SIZE + s)
    a = load_broadcast(footprints, ROW_A * CHUNK_SIZE + s) * x
    b = load_broadcast(footprints, ROW_B * CHUNK_SIZE + s) * x
    front = multiply_add(load_broadcast(footprints, ROW_L * CHUNK_SIZE + s), x, broadcast(np.float32(1)))
    a = multiply_add(load_broadcast(footprints, (ROW_A + 1) * CHUNK_SIZE + s), y, a)
    b = multiply_add(load_broadcast(footprints, (ROW_B + 1) * CHUNK_SIZE + s), y, b)
    front = multiply_add(load_broadcast(footprints, (ROW_L + 1) * CHUNK_SIZE + s), y, front)
    if is_3d:
        z = z - load_broadcast(footprints, (THIRD + 3) * CHUNK_SIZE + s)
        a = multiply_add(load_broadcast(footprints, THIRD * CHUNK_SIZE + s), z, a)
        b = multiply_add(load_broadcast(footprints, (THIRD + 1) * CHUNK_SIZE + s), z, b)
        front = multiply_add(load_broadcast(footprints, (THIRD + 2) * CHUNK_SIZE + s), z, front)
    return a, b, front


@inline_kernel_no_refcount
def compute_alpha(log2_alpha):
    """Alpha: 0 below the cut, at most MAX_ALPHA."""
    alpha = min(exp2(log2_alpha), broadcast(np.float32(MAX_ALPHA)))
    return select(broadcast(np.float32(LOG2_ALPHA_CUT)) <= log2_alpha, alpha, broadcast(np.float32(0)))


@inline_kernel_no_refcount
def _blend_values(block, count, log2_alphas, indices, begin, chunk_values, transmittance, tile_sums, min_transmittance):
    """Composite the Gaussians of a block; return whether a pixel is unfinished."""
    pixel = block * LANES
    transmitted = load(transmittance, pixel)
    sum0, sum1 = load(tile_sums, pixel), load(tile_sums, TILE_PIXELS + pixel)
    sum2, sum3 = load(tile_sums, 2 * TILE_PIXELS + pixel), load(tile_sums, 3 * TILE_PIXELS + pixel)
    for at in range(begin, begin + count, 2):  # after an odd number, the alpha that follows is 0
        first = VALUE_LANES * np.int64(load_scalar(indices, at))
        second = VALUE_LANES * np.int64(load_scalar(indices, at + 1))
        alpha = compute_alpha(load(log2_alphas, at * LANES))
        next_alpha = compute_alpha(load(log2_alphas, at * LANES + LANES))
        weight = alpha * transmitted
        transmitted = multiply_add(-alpha, transmitted, transmitted)
        sum0 = multiply_add(weight, load_broadcast(chunk_values, first), sum0)
        sum1 = multiply_add(weight, load_broadcast(chunk_values, first + 1), sum1)
        sum2 = multiply_add(weight, load_broadcast(chunk_values, first + 2), sum2)
        sum3 = multiply_add(weight, load_broadcast(chunk_values, first + 3), sum3)
        weight = next_alpha * transmitted
        transmitted = multiply_add(-next_alpha, transmitted, transmitted)
        sum0 = multiply_add(weight, load_broadcast(chunk_values, second), sum0)
        sum1 = multiply_add(weight, load_broadcast(chunk_values, second + 1), sum1)
        sum2 = multiply_add(weight, load_broadcast(chunk_values, second + 2), sum2)
        sum3 = multiply_add(weight, load_broadcast(chunk_values, second + 3), sum3)
    store(transmittance, pixel, transmitted)
    store(tile_sums, pixel, sum0)
    store(tile_sums, TILE_PIXELS + pixel, sum1)
    store(tile_sums, 2 * TILE_PIXELS + pixel, sum2)
    store(tile_sums, 3 * TILE_PIXELS + pixel, sum3)
    return any_lane(transmitted > broadcast(min_transmittance))


@inline_kernel_no_refcount
def _write_tile(transmittance, tile_sums, sums, left, top):
    """Copy a tile's sums into the image; the last one is the sum of the weights, 1 minus the transmittance."""
    for pixel in range(TILE_PIXELS):
        x, y = image_position(pixel, left, top)
        if x < sums.shape[2] and y < sums.shape[1]:
            for channel in range(VALUE_LANES):
                sums[channel, y, x] = tile_sums[channel * TILE_PIXELS + pixel]
            sums[VALUE_LANES, y, x] = np.float32(1) - transmittance[pixel]
