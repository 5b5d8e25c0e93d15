"""Gradients of records and values equal autograd through the dense sums in float64."""

import numpy as np
import pytest

from pansplat.rendering.cpu import records as layout
from pansplat.rendering.cpu.rasterize import allocate_saved, rasterize_forward
from pansplat.rendering.cpu.rasterize_backward import rasterize_backward
from pansplat.rendering.cpu.runtime import Workspace

_COLUMNS = {
    "direction": slice(layout.DIRECTION, layout.DIRECTION_RESIDUAL),
    "a": slice(layout.ROW_A, layout.ROW_B),
    "b": slice(layout.ROW_B, layout.L_ALONG_A),
    "l_along": slice(layout.L_ALONG_A, layout.RADIAL_VARIANCE),
    "radial_variance": slice(layout.RADIAL_VARIANCE, layout.LOG2_PEAK),
    "log2_peak": slice(layout.LOG2_PEAK, layout.RECORD_SIZE),
}


def _upstream(case):
    shape = case.values.shape[1] + 1, *case.size
    return np.random.default_rng(1).standard_normal(shape).astype(np.float32)


def _slots(case, upstream, *, threads=1):
    """Gradients of records and values, a row per slot."""
    sums, workspace = np.empty_like(upstream), Workspace()
    scene = case.records, case.values, case.intersections, case.starts
    saved = allocate_saved(case.starts, workspace)
    rasterize_forward(*scene, case.tables, sums, saved=saved)
    grad_records = workspace.array((len(case.intersections), layout.RECORD_SIZE), np.float32)
    grad_records[:] = np.nan
    grad_values = np.full((len(case.intersections), case.values.shape[1]), np.nan, np.float32)
    gradients = upstream, grad_records, grad_values
    rasterize_backward(*scene, case.slots, case.tables, sums, saved, *gradients, threads=threads)
    return grad_records.copy(), grad_values


def _compare(case):
    upstream = _upstream(case)
    _, expected_records, expected_values = (part.numpy() for part in case.dense(upstream))
    records, values = (case.reduce(part) for part in _slots(case, upstream))
    assert not records[:, layout.DIRECTION_RESIDUAL : layout.ROW_A].any()
    pairs = {name: (records[:, columns], expected_records[:, columns]) for name, columns in _COLUMNS.items()}
    for name, (found, expected) in (pairs | {"values": (values, expected_values)}).items():
        assert np.linalg.norm(found - expected) <= 1e-5 * np.linalg.norm(expected), name


@pytest.mark.parametrize("kind", ["equirect", "pinhole"])
@pytest.mark.parametrize("size", [(32, 64), (33, 31), (3, 2)])
def test_gradients_equal_autograd_of_the_dense_sums(kind, size, make_case):
    _compare(make_case(kind, size, 150))


def test_a_gaussian_that_needs_three_components_has_the_gradients_of_the_dense_sums(one_too_wide):
    _compare(one_too_wide)


@pytest.mark.parametrize("num_values", [1, 2, 5, 9])
def test_any_number_of_values_has_gradients(num_values, make_case):
    _compare(make_case("pinhole", (24, 40), 150, num_values=num_values))


def test_full_chunks_have_the_gradients_of_the_dense_sums(make_case):
    # Five chunks with the maximal number of pairs, so transparent that no Gaussian is hidden.
    case = make_case("pinhole", (32, 32), 1100, opacity=(0.006, 0.012))
    case.records[:, 6:12] *= 0.05
    _compare(case)


def test_clamped_alphas_have_no_gradient(make_case):
    case = make_case("pinhole", (16, 16), 3, opacity=(50.0, 60.0)).flatten()
    grad_records, grad_values = _slots(case, _upstream(case))
    assert not grad_records.any()
    assert grad_values.any()


def test_hidden_gaussians_have_zero_gradients_in_their_slots(make_case):
    case = make_case("pinhole", (32, 32), 900, opacity=(2.0, 3.0)).flatten()
    grad_records, grad_values = _slots(case, _upstream(case))
    # Four alphas of 0.99 finish all pixels, so the tile ends with its first chunk of 256.
    assert np.isfinite(grad_records).all() and np.isfinite(grad_values).all()
    values = case.reduce(grad_values)
    assert values[:2].any(axis=1).all()
    assert not values[256:].any()
