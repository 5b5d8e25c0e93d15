"""Footprints without blending, to inspect a scene: the number of Gaussians at each pixel, or opaque ellipsoids.

An alternative to stage three, on the records and boxes of stages one and two. Each item of work draws some rows of the
image, so that no two threads write the same pixel.
"""

import math
from functools import partial
from typing import Literal

import numpy as np

from pansplat.constants import ALPHA_CUT, ELLIPSOID_AMBIENT
from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.rasterize import pixel_point
from pansplat.rendering.cpu.records import PixelTables
from pansplat.rendering.cpu.runtime import inline_kernel_no_refcount, kernel, parallel_for

Footprint = Literal["count", "ellipsoids"]

_ROWS_PER_ITEM = 16
_LOG2_CUT = np.float32(math.log2(ALPHA_CUT))
_ONE_SIGMA = np.float32(layout.HALF_LOG2_E)  # of the exponent


def draw_footprints(
    footprint: Footprint,
    records: np.ndarray,
    values: np.ndarray,
    distances: np.ndarray,
    boxes: np.ndarray,
    tables: PixelTables,
    sums: np.ndarray,
    threads: int,
) -> None:
    """Write the sums of one image plane.

    Args:
        footprint: `count` adds 1 to RGB and weight for each Gaussian that reaches the alpha cut. `ellipsoids` writes
            the shaded colour, the distance and weight 1 of the nearest Gaussian within one standard deviation.
        records, values: of the projected Gaussians.
        distances: that order them.
        boxes: (n, 4) int16.
        tables: the pixels.
        sums: (5, height, width), written.
        threads: number of threads.
    """
    draw = partial(_draw_rows, footprint == "count", *tables, records, values, distances, boxes, sums)
    parallel_for(draw, -(-sums.shape[1] // _ROWS_PER_ITEM), threads)


@inline_kernel_no_refcount
def _measure(record, d_x, d_y, d_z):
    """The exponent of a Gaussian's response at a pixel, times log2(e); negative behind the camera."""
    x = np.float32((d_x - record[0]) - record[3])
    y = np.float32((d_y - record[1]) - record[4])
    z = np.float32((d_z - record[2]) - record[5])
    along_a, along_b = record[layout.L_ALONG_A], record[layout.L_ALONG_B]
    a = record[6] * x + record[7] * y + record[8] * z
    b = record[9] * x + record[10] * y + record[11] * z
    front = np.float32(1) + (record[0] * x + record[1] * y + record[2] * z + along_a * a + along_b * b)
    square = a * a + b * b
    exponent = square / (front * front + record[layout.RADIAL_VARIANCE] * square)
    return exponent if front > np.float32(0) else np.float32(-1)


@kernel
def _draw_rows(counts, kind, columns, rows, rotation, records, values, distances, boxes, sums, item):
    first, end = item * _ROWS_PER_ITEM, min((item + 1) * _ROWS_PER_ITEM, len(rows))
    width = len(columns)
    nearest = np.full((end - first, width), np.inf)
    directions = np.empty((end - first, width, 3))
    for y in range(first, end):
        for x in range(width):
            directions[y - first, x] = pixel_point(kind, columns, rows, rotation, x, y)
            for channel in range(len(sums)):  # assigned to a slice, a number takes two seconds to compile
                sums[channel, y, x] = np.float32(0)
    for g in range(len(boxes)):
        left, right, top, bottom = boxes[g, 0], boxes[g, 1], max(boxes[g, 2], first), min(boxes[g, 3], end - 1)
        record, peak, distance = records[g], records[g, layout.LOG2_PEAK], distances[g]
        across = right - left + 1 if right >= left else right - left + 1 + width  # a box may wrap around
        for y in range(top, bottom + 1):
            for i in range(across):
                x = left + i if left + i < width else left + i - width
                d = directions[y - first, x]
                exponent = _measure(record, d[0], d[1], d[2])
                if exponent < 0 or peak - exponent < _LOG2_CUT:
                    continue
                if counts:
                    for channel in range(5):
                        sums[channel, y, x] += np.float32(channel != 3)
                elif exponent <= _ONE_SIGMA and distance < nearest[y - first, x]:
                    nearest[y - first, x] = distance
                    facing = math.sqrt(max(np.float32(1) - exponent / _ONE_SIGMA, np.float32(0)))
                    shade = np.float32(ELLIPSOID_AMBIENT + (1 - ELLIPSOID_AMBIENT) * facing)
                    for channel in range(3):
                        sums[channel, y, x] = shade * values[g, channel]
                    sums[3, y, x], sums[4, y, x] = values[g, 3], np.float32(1)
