"""Tile lists: each tile holds the Gaussians whose box touches it, by number, with the box cut to the tile."""

import numpy as np
import pytest

from pansplat.rendering.cpu.bins import list_tiles


def _random_boxes(count, size, *, wraps, seed=0):
    random = np.random.default_rng(seed)
    height, width = size
    extent = np.exp(random.uniform(0, 5, (count, 2))).astype(int)
    x0, y0 = random.integers(0, width, count), random.integers(0, height, count)
    x1, y1 = x0 + np.minimum(extent[:, 0], width - 1), np.minimum(y0 + extent[:, 1], height - 1)
    x1 = x1 % width if wraps else np.minimum(x1, width - 1)
    boxes = np.stack((x0, x1, y0, y1), axis=1).astype(np.int16)
    boxes[::7] = (0, 0, 1, 0)
    return boxes


def _inside(box, size):
    """The picture's pixels that a box holds."""
    x0, x1, y0, y1 = box
    columns = np.arange(size[1])
    across = (columns >= x0) & (columns <= x1) if x1 >= x0 else (columns >= x0) | (columns <= x1)
    rows = np.arange(size[0])
    return ((rows >= y0) & (rows <= y1))[:, None] & across[None, :]


def _check(lists, boxes, size):
    columns = -(-size[1] // 32)
    inside = [_inside(box, size) for box in boxes]
    for number in range(len(lists.starts) - 1):
        top, left = 32 * (lists.first_row + number // columns), 32 * (number % columns)
        expected = [pixels[top : top + 32, left : left + 32] for pixels in inside]
        touching = [g for g, pixels in enumerate(expected) if pixels.any()]
        entries = lists.entries[lists.starts[number] : lists.starts[number + 1]]
        assert entries[:, 0].tolist() == touching
        for g, packed in entries.tolist():
            x0, x1, y0, y1 = (packed >> shift & 255 for shift in (0, 8, 16, 24))
            rows, across = np.nonzero(expected[g])
            assert (y0, y1) == (rows.min(), rows.max())
            assert (x0, x1) == (across.min(), across.max())


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("size", [(100, 200), (1, 1), (33, 31), (64, 32)])
def test_each_tile_lists_the_gaussians_that_touch_it(size, wraps, threads):
    boxes = _random_boxes(60, size, wraps=wraps)
    (lists,) = list_tiles(boxes, size, slots=True, threads=threads)
    _check(lists, boxes, size)


def test_each_pair_has_a_slot_of_its_own_among_its_gaussians():
    size = (100, 200)
    boxes = _random_boxes(60, size, wraps=True)
    lists = [next(list_tiles(boxes, size, slots=True, threads=threads)) for threads in (1, 3)]
    for one in lists:
        assert np.array_equal(np.sort(one.slots), np.arange(len(one.entries)))
        owner = np.searchsorted(one.offsets, one.slots, side="right") - 1
        assert np.array_equal(owner, one.entries[:, 0])
    assert np.array_equal(lists[0].slots, lists[1].slots)


@pytest.mark.parametrize("threads", [1, 3])
def test_bands_hold_what_one_list_holds(threads):
    size = (300, 200)
    boxes = _random_boxes(200, size, wraps=True)
    (whole,) = list_tiles(boxes, size, slots=False, threads=1)
    bands = list(list_tiles(boxes, size, slots=True, threads=threads, limit=300))
    assert len(bands) == 3
    assert np.array_equal(np.concatenate([band.entries for band in bands]), whole.entries)
    assert [band.first_row for band in bands] == sorted(band.first_row for band in bands)
    for band in bands:
        owner = np.searchsorted(band.offsets, band.slots, side="right") - 1
        assert np.array_equal(owner, band.entries[:, 0])
        assert np.array_equal(np.sort(band.slots), np.arange(len(band.entries)))


def test_no_gaussians_are_empty_lists():
    boxes = np.empty((0, 4), np.int16)
    (lists,) = list_tiles(boxes, (40, 70), slots=True, threads=2)
    assert lists.starts.tolist() == [0] * 7 and len(lists.entries) == 0
