"""Bounding boxes, tile intersections, and their order by distance."""

import math

import numpy as np
import pytest
import torch

from pansplat.rendering.cpu.projection import Camera
from pansplat.rendering.cpu.records import TILE_SIZE
from pansplat.rendering.cpu.tiling import (
    TileIntersections,
    compute_depths,
    find_bounding_boxes,
    intersect_tiles,
    radix_argsort,
    sort_front_to_back,
)
from pansplat.rendering.image_planes import image_planes
from pansplat.rendering.projection import equirect_boxes, kappa, pinhole_boxes


def _reference_boxes(projected, plane):
    """The reference's boxes in pixels, and which Gaussians are visible."""
    cut, (height, width) = kappa(projected.peak), plane.size
    if plane.is_panorama:
        edges = equirect_boxes(projected.direction, projected.covariance, cut, plane.size)
    else:
        rotation = plane.rotation
        covariance = rotation.T @ projected.covariance @ rotation
        edges = pinhole_boxes(projected.direction @ rotation, covariance, cut, plane.size, plane.focal)
    left, right, top, bottom = edges.numpy().T
    x0, x1 = np.ceil(left - 0.51), np.floor(right - 0.49)
    y0, y1 = np.maximum(np.ceil(top - 0.51), 0), np.minimum(np.floor(bottom - 0.49), height - 1)
    if plane.is_panorama:
        visible, full_width = (x0 <= x1) & (y0 <= y1) & (left <= right), x1 - x0 >= width - 1
        x0, x1 = np.where(full_width, 0, x0 % width), np.where(full_width, width - 1, x1 % width)
    else:
        x0, x1 = np.maximum(x0, 0), np.minimum(x1, width - 1)
        visible = (x0 <= x1) & (y0 <= y1) & (left <= right)
    return np.stack((x0, x1, y0, y1), axis=1), visible


@pytest.mark.parametrize("scale", [0.01, 0.3, 2.0])
@pytest.mark.parametrize(("layout", "size"), [("equirect", (64, 128)), ("pinhole", (64, 96)), ("cubemap", (64, 128))])
def test_bounding_boxes_equal_the_reference(layout, size, scale, make_scene, project, project_reference, workspace):
    scene = make_scene(2000, scale=scale)
    projected, reference = project(scene).projected, project_reference(scene)
    for plane in image_planes(layout, size):
        boxes = find_bounding_boxes(projected.records, plane, workspace, 1)
        expected, expected_visible = _reference_boxes(reference, plane)
        visible = boxes[:, 3] >= boxes[:, 2]
        # A box may end within rounding of a pixel's centre, or of the plane through the camera centre.
        assert (visible != expected_visible).mean() < 2e-3
        both = visible & expected_visible
        assert both.sum() > 50
        assert (boxes[both] != expected[both]).any(axis=1).mean() < 2e-3


@pytest.fixture
def panorama_boxes(make_scene, project, workspace):
    """Boxes of small Gaussians at the given means on a panorama of 64 x 128 pixels."""

    def find(*means):
        scene = make_scene(len(means), scale=0.05)
        scene.means[:] = torch.tensor(means)
        projected = project(scene, camera=Camera(np.eye(4), 1e-4, True, 0.05)).projected
        return find_bounding_boxes(projected.records, image_planes("equirect", (64, 128))[0], workspace, 1).tolist()

    return find


def test_gaussians_at_the_poles_span_all_columns(panorama_boxes):
    north, south = panorama_boxes((0.0, -1.0, 0.0), (0.0, 1.0, 0.0))
    assert north[:3] == [0, 127, 0]
    assert (south[0], south[1], south[3]) == (0, 127, 63)


def test_a_box_at_the_seam_of_the_panorama_wraps_around(panorama_boxes):
    ((x0, x1, y0, y1),) = panorama_boxes((0.0, 0.0, -1.0))
    assert 100 < x0 < 128 and 0 <= x1 < 28
    assert math.isclose(x0 + x1, 127, abs_tol=2) and y0 < 32 <= y1


def _random_boxes(count, size, *, wraps):
    random = np.random.default_rng(0)
    height, width = size
    extent = np.exp(random.uniform(0, 5, (count, 2))).astype(int)
    x0, y0 = random.integers(0, width, count), random.integers(0, height, count)
    x1, y1 = x0 + np.minimum(extent[:, 0], width - 1), np.minimum(y0 + extent[:, 1], height - 1)
    x1 = x1 % width if wraps else np.minimum(x1, width - 1)
    boxes = np.stack((x0, x1, y0, y1), axis=1).astype(np.int16)
    boxes[::7] = (0, 0, 1, 0)
    return boxes


def _pixels_in(box, size):
    x0, x1, y0, y1 = box
    columns, rows = np.arange(size[1]), np.arange(size[0])
    across = (columns >= x0) & (columns <= x1) if x1 >= x0 else (columns >= x0) | (columns <= x1)
    return ((rows >= y0) & (rows <= y1))[:, None] & across[None, :]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("wraps", [False, True])
@pytest.mark.parametrize("size", [(100, 200), (1, 1), (33, 31), (64, 32)])
def test_a_tile_intersects_the_boxes_that_share_a_pixel_with_it(size, wraps, threads):
    boxes = _random_boxes(60, size, wraps=wraps)
    (tiles,) = intersect_tiles(boxes, size, slots=True, threads=threads)
    num_columns = -(-size[1] // TILE_SIZE)
    pixels = [_pixels_in(box, size) for box in boxes]
    for tile in range(len(tiles.starts) - 1):
        top, left = TILE_SIZE * (tile // num_columns), TILE_SIZE * (tile % num_columns)
        expected = [image[top : top + TILE_SIZE, left : left + TILE_SIZE] for image in pixels]
        intersections = tiles.intersections[tiles.starts[tile] : tiles.starts[tile + 1]]
        assert intersections[:, 0].tolist() == [g for g, image in enumerate(expected) if image.any()]
        for g, packed in intersections.tolist():
            x0, x1, y0, y1 = (packed >> shift & 255 for shift in (0, 8, 16, 24))
            rows, columns = np.nonzero(expected[g])
            assert (x0, x1, y0, y1) == (columns.min(), columns.max(), rows.min(), rows.max())


def _check_slots(tiles):
    """Every intersection has its own slot, among those of its Gaussian."""
    assert np.array_equal(np.sort(tiles.slots), np.arange(len(tiles.intersections)))
    owner = np.searchsorted(tiles.offsets, tiles.slots, side="right") - 1
    assert np.array_equal(owner, tiles.intersections[:, 0])


def test_slots_of_a_gaussian_are_contiguous_and_independent_of_the_threads():
    size = (100, 200)
    boxes = _random_boxes(60, size, wraps=True)
    single, several = (next(intersect_tiles(boxes, size, slots=True, threads=threads)) for threads in (1, 3))
    _check_slots(single)
    assert np.array_equal(single.slots, several.slots)


@pytest.mark.parametrize("threads", [1, 3])
def test_bands_together_equal_the_whole_image(threads):
    size = (300, 200)
    boxes = _random_boxes(200, size, wraps=True)
    (whole,) = intersect_tiles(boxes, size, slots=False, threads=1)
    bands = list(intersect_tiles(boxes, size, slots=True, threads=threads, limit=300))
    assert len(bands) == 3
    assert np.array_equal(np.concatenate([band.intersections for band in bands]), whole.intersections)
    assert [band.first_row for band in bands] == sorted(band.first_row for band in bands)
    for band in bands:
        _check_slots(band)


def test_without_gaussians_all_tiles_are_empty():
    (tiles,) = intersect_tiles(np.empty((0, 4), np.int16), (40, 70), slots=True, threads=2)
    assert tiles.starts.tolist() == [0] * 7 and len(tiles.intersections) == 0


def _make_tiles(counts, workspace, *, slots=True):
    """Tiles with these numbers of intersections, each with the Gaussians from 0 on."""
    gaussians = np.concatenate([np.arange(count) for count in counts])
    intersections = np.stack((gaussians, 7 * np.arange(len(gaussians)) + 1), axis=1).astype(np.int32)
    starts = np.concatenate(((0,), np.cumsum(counts))).astype(np.int64)
    numbers = (3 * np.arange(len(gaussians) if slots else 0) + 5).astype(np.int32)
    return TileIntersections(0, intersections, starts, numbers, np.empty(0), workspace)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("slots", [True, False])
def test_intersections_are_sorted_within_their_tile_with_their_slots(threads, slots, workspace):
    counts = [0, 1, 2, 5, 0, 300, 3000, 17, 40]
    tiles = _make_tiles(counts, workspace, slots=slots)
    intersections, numbers = tiles.intersections.copy(), tiles.slots.copy()
    distances = np.random.default_rng(0).integers(1, 900, max(counts)) / 64.0
    sort_front_to_back(tiles, distances, threads)
    for first, end in zip(tiles.starts[:-1], tiles.starts[1:], strict=True):
        order = first + np.argsort(distances[intersections[first:end, 0]], kind="stable")
        assert np.array_equal(tiles.intersections[first:end], intersections[order])
        if slots:
            assert np.array_equal(tiles.slots[first:end], numbers[order])


def _order(distances, workspace):
    """The Gaussians of one tile, sorted."""
    tiles = _make_tiles([len(distances)], workspace, slots=False)
    sort_front_to_back(tiles, distances, 1)
    return tiles.intersections[:, 0].tolist()


def _crowd(far):
    """4000 nearly equal distances and one far away, for which insertion takes too many moves."""
    distances = 2 + 1e-11 * np.random.default_rng(2).permutation(4000)
    distances[1234] = far
    return distances


@pytest.mark.parametrize(
    "distances",
    [
        pytest.param(np.full(5000, 2.5), id="equal"),
        pytest.param(3 + 2.0**-38 * np.arange(1000)[::-1], id="closer than float32"),
        pytest.param(10.0 ** np.random.default_rng(1).permutation(np.linspace(-18, 18, 5000)), id="36 decades"),
        *(pytest.param(_crowd(far), id=f"crowd, one at {far}") for far in (1e30, 4.0, 3.0)),
    ],
)
def test_sorting_is_stable_for_any_distribution(distances, workspace):
    assert _order(distances, workspace) == np.argsort(distances, kind="stable").tolist()


@pytest.mark.parametrize("count", [0, 1, 3000])
def test_the_order_of_float32_keys_is_that_of_a_stable_sort(count):
    random = np.random.default_rng(5)
    keys = (random.standard_normal(count) * 10.0 ** random.integers(-30, 30, count)).astype(np.float32)
    keys[::7], keys[3::7], keys[5::7], keys[6:20] = 0.0, -0.0, keys[5::7][::-1], np.inf
    assert np.array_equal(radix_argsort(keys), np.argsort(keys, kind="stable"))


def test_distances_that_differ_by_rounding_are_ties(workspace):
    distances = 3.3 + np.spacing(3.3) * np.arange(20)[::-1]
    assert _order(distances, workspace) == list(range(20))


def test_depths_of_both_signs_are_sorted(workspace):
    depths = np.random.default_rng(3).standard_normal(5000)
    depths[:5] = 0.0, -0.0, 1e-300, -1e-300, -0.0
    order = _order(depths, workspace)  # keys and indices exceed 64 bits, so keys are cut
    assert np.array_equal(depths[order], np.sort(depths, kind="stable"))
    assert order.index(0) < order.index(1) < order.index(4)


def test_depth_is_the_projection_on_the_axis(workspace):
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
