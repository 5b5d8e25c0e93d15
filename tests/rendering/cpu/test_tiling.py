"""Boxes found from records are the reference's, pixel by pixel."""

import math

import numpy as np
import pytest
import torch

from pansplat.rendering.cpu.projection import Camera
from pansplat.rendering.cpu.tiling import (
    TileIntersections,
    compute_depths,
    find_bounding_boxes,
    intersect_tiles,
    sort_front_to_back,
)
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import equirect_boxes, kappa, pinhole_boxes

# Tile lists: each tile holds the Gaussians whose box touches it, by number, with the box cut to the tile.

# Each tile's intersections front to back: stable, exact but for rounding, the same on any number of threads.


def _expected(observed, picture):
    """The reference's boxes as pixels; and which Gaussians are seen."""
    level, (height, width) = kappa(observed.peak), picture.size
    if picture.is_panorama:
        edges = equirect_boxes(observed.direction, observed.covariance, level, picture.size)
    else:
        turn = picture.rotation
        covariance = turn.T @ observed.covariance @ turn
        edges = pinhole_boxes(observed.direction @ turn, covariance, level, picture.size, picture.focal)
    left, right, top, bottom = edges.numpy().T
    x0, x1 = np.ceil(left - 0.51), np.floor(right - 0.49)
    y0, y1 = np.maximum(np.ceil(top - 0.51), 0), np.minimum(np.floor(bottom - 0.49), height - 1)
    if picture.is_panorama:
        seen, around = (x0 <= x1) & (y0 <= y1) & (left <= right), x1 - x0 >= width - 1
        x0, x1 = np.where(around, 0, x0 % width), np.where(around, width - 1, x1 % width)
    else:
        x0, x1 = np.maximum(x0, 0), np.minimum(x1, width - 1)
        seen = (x0 <= x1) & (y0 <= y1) & (left <= right)
    return np.stack((x0, x1, y0, y1), axis=1), seen


@pytest.mark.parametrize("scale", [0.01, 0.3, 2.0])
@pytest.mark.parametrize(("layout", "size"), [("equirect", (64, 128)), ("pinhole", (64, 96)), ("cubemap", (64, 128))])
def test_boxes_are_the_references(layout, size, scale, make_scene, project, project_reference, workspace):
    scene = make_scene(2000, scale=scale)
    observed, expected = project(scene).projected, project_reference(scene)
    for picture in image_planes(layout, size, vertical_fov_degrees=90.0, face_size=None, device=torch.device("cpu")):
        boxes = find_bounding_boxes(observed.records, picture, workspace, 1)
        wanted, is_seen = _expected(expected, picture)
        found = boxes[:, 3] >= boxes[:, 2]
        # A box may end within rounding of a pixel's centre, or of the plane through the eye.
        assert (found != is_seen).mean() < 2e-3
        both = found & is_seen
        assert both.sum() > 50
        assert (boxes[both] != wanted[both]).any(axis=1).mean() < 2e-3


def test_a_gaussian_on_the_axis_of_the_poles_takes_whole_rows(make_scene, project, workspace):
    scene = make_scene(2, scale=0.05)
    scene.means[:] = torch.tensor(((0.0, -1.0, 0.0), (0.0, 1.0, 0.0)))
    observed = project(scene, camera=Camera(np.eye(4), 1e-4, True, 0.05)).projected
    (picture,) = image_planes(
        "equirect", (64, 128), vertical_fov_degrees=90, face_size=None, device=torch.device("cpu")
    )
    boxes = find_bounding_boxes(observed.records, picture, workspace, 1)
    assert boxes[:, :2].tolist() == [[0, 127], [0, 127]]
    assert boxes[0, 2] == 0 and boxes[1, 3] == 63


def test_a_box_at_the_panoramas_seam_goes_on_at_the_left(make_scene, project, workspace):
    scene = make_scene(1, scale=0.05)
    scene.means[:] = torch.tensor((0.0, 0.0, -1.0))
    observed = project(scene, camera=Camera(np.eye(4), 1e-4, True, 0.05)).projected
    (picture,) = image_planes(
        "equirect", (64, 128), vertical_fov_degrees=90, face_size=None, device=torch.device("cpu")
    )
    x0, x1, y0, y1 = find_bounding_boxes(observed.records, picture, workspace, 1)[0]
    assert 100 < x0 < 128 and 0 <= x1 < 28
    assert math.isclose(x0 + x1, 127, abs_tol=2) and y0 < 32 <= y1


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
        intersections = lists.intersections[lists.starts[number] : lists.starts[number + 1]]
        assert intersections[:, 0].tolist() == touching
        for g, packed in intersections.tolist():
            x0, x1, y0, y1 = (packed >> shift & 255 for shift in (0, 8, 16, 24))
            rows, across = np.nonzero(expected[g])
            assert (y0, y1) == (rows.min(), rows.max())
            assert (x0, x1) == (across.min(), across.max())


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("size", [(100, 200), (1, 1), (33, 31), (64, 32)])
def test_each_tile_lists_the_gaussians_that_touch_it(size, wraps, threads):
    boxes = _random_boxes(60, size, wraps=wraps)
    (lists,) = intersect_tiles(boxes, size, slots=True, threads=threads)
    _check(lists, boxes, size)


def test_each_pair_has_a_slot_of_its_own_among_its_gaussians():
    size = (100, 200)
    boxes = _random_boxes(60, size, wraps=True)
    lists = [next(intersect_tiles(boxes, size, slots=True, threads=threads)) for threads in (1, 3)]
    for one in lists:
        assert np.array_equal(np.sort(one.slots), np.arange(len(one.intersections)))
        owner = np.searchsorted(one.offsets, one.slots, side="right") - 1
        assert np.array_equal(owner, one.intersections[:, 0])
    assert np.array_equal(lists[0].slots, lists[1].slots)


@pytest.mark.parametrize("threads", [1, 3])
def test_bands_hold_what_one_list_holds(threads):
    size = (300, 200)
    boxes = _random_boxes(200, size, wraps=True)
    (whole,) = intersect_tiles(boxes, size, slots=False, threads=1)
    bands = list(intersect_tiles(boxes, size, slots=True, threads=threads, limit=300))
    assert len(bands) == 3
    assert np.array_equal(np.concatenate([band.intersections for band in bands]), whole.intersections)
    assert [band.first_row for band in bands] == sorted(band.first_row for band in bands)
    for band in bands:
        owner = np.searchsorted(band.offsets, band.slots, side="right") - 1
        assert np.array_equal(owner, band.intersections[:, 0])
        assert np.array_equal(np.sort(band.slots), np.arange(len(band.intersections)))


def test_no_gaussians_are_empty_lists():
    boxes = np.empty((0, 4), np.int16)
    (lists,) = intersect_tiles(boxes, (40, 70), slots=True, threads=2)
    assert lists.starts.tolist() == [0] * 7 and len(lists.intersections) == 0


def _lists(counts, workspace, *, slots=True):
    """Tiles with `counts` intersections each: Gaussians from 0 on, in order."""
    numbers = np.concatenate([np.arange(count) for count in counts]) if counts else np.empty(0, int)
    intersections = np.stack((numbers, 7 * np.arange(len(numbers)) + 1), axis=1).astype(np.int32)
    places = (3 * np.arange(len(numbers) if slots else 0) + 5).astype(np.int32)
    return TileIntersections(
        0, intersections, np.concatenate(((0,), np.cumsum(counts))).astype(np.int64), places, np.empty(0), workspace
    )


def _sorted(distances, workspace, threads=1):
    """The order of one tile."""
    lists = _lists([len(distances)], workspace, slots=False)
    sort_front_to_back(lists, np.asarray(distances, np.float64), threads)
    return lists.intersections[:, 0].tolist()


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
@pytest.mark.parametrize("slots", [True, False])
def test_every_tile_is_in_order_and_boxes_and_slots_go_along(threads, slots, workspace):
    counts = [0, 1, 2, 5, 0, 300, 3000, 17, 40]
    lists = _lists(counts, workspace, slots=slots)
    intersections, places = lists.intersections.copy(), lists.slots.copy()
    distances = np.random.default_rng(0).integers(1, 900, max(counts)) / 64.0
    sort_front_to_back(lists, distances, threads)
    for first, end in zip(lists.starts[:-1], lists.starts[1:], strict=True):
        order = first + np.argsort(distances[intersections[first:end, 0]], kind="stable")
        assert np.array_equal(lists.intersections[first:end], intersections[order])
        if slots:
            assert np.array_equal(lists.slots[first:end], places[order])


def test_equal_distances_stay_in_the_order_of_their_numbers(workspace):
    assert _sorted(np.full(5000, 2.5), workspace) == list(range(5000))


def test_distances_are_told_apart_far_below_float32(workspace):
    distances = 3 + 2.0**-38 * np.arange(1000)[::-1]
    assert _sorted(distances, workspace) == list(range(1000))[::-1]


def test_distances_that_only_rounding_tells_apart_stay_in_the_order_of_their_numbers(workspace):
    distances = 3.3 + np.spacing(3.3) * np.arange(20)[::-1]
    assert _sorted(distances, workspace) == list(range(20))


def test_a_range_of_36_powers_of_ten_is_sorted(workspace):
    distances = 10.0 ** np.random.default_rng(1).permutation(np.linspace(-18, 18, 5000))
    assert np.array_equal(_sorted(distances, workspace), np.argsort(distances, kind="stable"))


@pytest.mark.parametrize("far", [1e30, 4.0, 3.0])
def test_many_that_crowd_together_before_one_far_away_are_sorted(far, workspace):
    distances = 2 + 1e-11 * np.random.default_rng(2).permutation(4000)
    distances[1234] = far
    assert np.array_equal(_sorted(distances, workspace), np.argsort(distances, kind="stable"))


def test_depths_of_both_signs_come_out_in_order(workspace):
    depths = np.random.default_rng(3).standard_normal(5000)
    depths[:5] = 0.0, -0.0, 1e-300, -1e-300, -0.0
    # Of 64 bits with the places: some are cut from the keys.
    order = _sorted(depths, workspace)
    assert np.array_equal(depths[order], np.sort(depths, kind="stable"))
    assert order.index(0) < order.index(1) < order.index(4)


def test_depths_lie_along_the_axis(workspace):
    random = np.random.default_rng(4)
    directions = random.standard_normal((5000, 3))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    records = np.zeros((5000, 16), np.float32)
    records[:, :3] = directions
    records[:, 3:6] = directions - records[:, :3]
    radii, axis = random.uniform(1, 9, 5000), np.array((0.6, 0.0, 0.8))
    for threads in (1, 3):
        depths = compute_depths(records, radii, axis, workspace, threads)
        assert np.allclose(depths, radii * (directions @ axis), rtol=0, atol=1e-13)
