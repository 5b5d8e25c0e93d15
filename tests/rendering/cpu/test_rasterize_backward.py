"""TODO."""

import numpy as np
import pytest

from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.rasterize import allocate_saved, rasterize_forward
from pansplat.rendering.cpu.rasterize_backward import rasterize_backward
from pansplat.rendering.cpu.runtime import Workspace

FIELDS = {
    "direction": slice(layout.DIRECTION, layout.DIRECTION_RESIDUAL),
    "first": slice(layout.ROW_A, layout.ROW_B),
    "second": slice(layout.ROW_B, layout.L_ALONG_A),
    "fronts": slice(layout.L_ALONG_A, layout.RADIAL_VARIANCE),
    "along": slice(layout.RADIAL_VARIANCE, layout.LOG2_PEAK),
    "level": slice(layout.LOG2_PEAK, layout.RECORD_SIZE),
}


def _upstream(case):
    shape = case.values.shape[1] + 1, *case.size
    return np.random.default_rng(1).standard_normal(shape).astype(np.float32)


def _slots(case, upstream, *, threads=1):
    sums = np.empty_like(upstream)
    drawn = case.records, case.values, case.intersections, case.starts
    kept = allocate_saved(case.starts, workspace := Workspace())
    rasterize_forward(*drawn, case.tables, sums, saved=kept)
    grad_records = workspace.array((len(case.intersections), layout.RECORD_SIZE), np.float32)
    grad_records[:] = np.nan
    grad_values = np.full((len(case.intersections), case.values.shape[1]), np.nan, np.float32)
    rasterize_backward(
        *drawn, case.slots, case.tables, sums, kept, upstream, grad_records, grad_values, threads=threads
    )
    return grad_records.copy(), grad_values


def _compare(case, tolerance=1e-5):
    upstream = _upstream(case)
    _, by_records, by_values = case.dense(upstream)
    slots = _slots(case, upstream)
    records, values = (case.reduce(part) for part in slots)
    assert not records[:, layout.DIRECTION_RESIDUAL : layout.ROW_A].any()
    for name, columns in FIELDS.items():
        expected = by_records[:, columns].numpy()
        error = np.linalg.norm(records[:, columns] - expected)
        assert error <= tolerance * np.linalg.norm(expected), (name, error / np.linalg.norm(expected))
    expected = by_values.numpy()
    assert np.linalg.norm(values - expected) <= tolerance * np.linalg.norm(expected)


@pytest.mark.parametrize("kind", ["equirect", "pinhole", "ewa"])
@pytest.mark.parametrize("size", [(32, 64), (33, 31), (3, 2)])
def test_gradients_are_autograds_of_the_dense_sums(kind, size, make_case):
    _compare(make_case(kind, size, 150))


def test_one_gaussian_too_wide_for_two_components_has_its_gradients_too(one_too_wide):
    _compare(one_too_wide)


@pytest.mark.parametrize("num_values", [1, 2, 5, 9])
def test_any_number_of_values_has_gradients(num_values, make_case):
    _compare(make_case("pinhole", (24, 40), 150, num_values=num_values))


def test_opacities_at_the_limit_have_no_gradient(make_case):
    case = make_case("ewa", (16, 16), 3, opacity=(50.0, 60.0))
    case.records[:, 6:12] = 1e-3 * np.array((1, 0, 0, 0, 1, 0))
    grad_records, grad_values = _slots(case, _upstream(case))
    assert not grad_records.any()
    assert grad_values.any()


def test_many_chunks_of_gaussians_that_fill_a_tile_change_nothing(make_case):
    # Five chunks, each with as many pairs as there is room for; thin enough for all to be seen.
    case = make_case("ewa", (32, 32), 1100, opacity=(0.006, 0.012))
    case.records[:, 6:12] = 0.05 * case.records[:, 6:12]
    _compare(case)


def test_what_is_hidden_has_no_gradient_and_every_slot_is_written(make_case):
    case = make_case("ewa", (32, 32), 900, opacity=(2.0, 3.0))
    case.records[:, 6:12] = 1e-3 * np.array((1, 0, 0, 0, 1, 0))
    grad_records, grad_values = _slots(case, _upstream(case))
    # Four at 0.99 close the tile, which the first chunk of 256 then ends.
    assert np.isfinite(grad_records).all() and np.isfinite(grad_values).all()
    values = case.reduce(grad_values)
    assert values[:2].any(axis=1).all()
    assert not values[256:].any()


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_any_number_of_threads_gives_the_same_bits(threads, make_case):
    case = make_case("equirect", (96, 192), 60)
    upstream = _upstream(case)
    for alone, shared in zip(_slots(case, upstream), _slots(case, upstream, threads=threads), strict=True):
        assert np.array_equal(alone, shared)


def test_gradients_are_linear_in_what_comes_from_above(make_case):
    case = make_case("equirect", (32, 64), 50)
    upstream = _upstream(case)
    once, twice = _slots(case, upstream), _slots(case, -2 * upstream)
    for one, two in zip(once, twice, strict=True):
        np.testing.assert_allclose(two, -2 * one, rtol=1e-4, atol=1e-5)
