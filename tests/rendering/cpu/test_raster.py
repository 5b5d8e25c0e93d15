import os
import subprocess
import sys

import numpy as np
import pytest

from pansplat.rendering.cpu.raster import raster_forward
from pansplat.rendering.cpu.records import TILE


def _draw(case, *, threads=1):
    sums = np.full((case.values.shape[1] + 1, *case.size), np.nan, np.float32)
    raster_forward(case.records, case.values, case.entries, case.starts, case.plane, sums, threads=threads)
    return sums


@pytest.mark.parametrize("kind", ["equirect", "pinhole", "ewa"])
@pytest.mark.parametrize("size", [(32, 64), (1, 1), (2, 3), (33, 31), (5, 100)])
def test_pictures_are_the_dense_sums(kind, size, make_case):
    case = make_case(kind, size, 150)
    expected = case.dense()[0].numpy()
    assert expected[-1].max() > 0.1
    np.testing.assert_allclose(_draw(case), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("num_values", [1, 2, 5, 9])
def test_any_number_of_values_is_summed(num_values, make_case):
    case = make_case("pinhole", (24, 40), 150, num_values=num_values)
    np.testing.assert_allclose(_draw(case), case.dense()[0].numpy(), rtol=0, atol=2e-6)


def test_more_gaussians_than_a_chunk_are_drawn_in_order(make_case):
    case = make_case("equirect", (32, 64), 700)
    np.testing.assert_allclose(_draw(case), case.dense()[0].numpy(), rtol=0, atol=2e-6)


@pytest.mark.parametrize("threads", [2, 3, 5])
def test_any_number_of_threads_draws_the_same_bits(threads, make_case):
    case = make_case("equirect", (96, 192), 60)
    assert np.array_equal(_draw(case), _draw(case, threads=threads))


def test_a_band_is_its_part_of_the_picture(make_case):
    case = make_case("pinhole", (100, 60), 60)
    whole, across = _draw(case), case.plane.tiles[1]
    band = np.zeros_like(whole)
    starts = np.ascontiguousarray(case.starts[across : 3 * across + 1])
    raster_forward(case.records, case.values, case.entries, starts, case.plane, band, first_row=1)
    inside = slice(TILE, 3 * TILE)
    assert np.array_equal(band[:, inside], whole[:, inside])
    assert not band[:, :TILE].any() and not band[:, 3 * TILE :].any()


def test_no_entries_leave_an_empty_picture(make_case):
    case = make_case("equirect", (32, 64), 0)
    assert np.array_equal(_draw(case), np.zeros((5, 32, 64)))


def test_only_blocks_that_touch_the_box_are_drawn(make_case):
    case = make_case("ewa", (32, 32), 1)
    case.records[0, 6:12] = 1e-3 * np.array((1, 0, 0, 0, 1, 0))  # covers the tile
    case.entries[:, 1] = 9 | 13 << 8 | 5 << 16 | 6 << 24
    drawn = _draw(case)[-1] > 0
    expected = np.zeros((32, 32), bool)
    expected[4:8, 8:16] = True  # blocks are four wide and two high
    assert np.array_equal(drawn, expected)


def test_nothing_is_drawn_behind_the_camera(make_case):
    case = make_case("equirect", (32, 64), 1)
    # Towards z, and as wide as a hand: the same cone opens backwards, where only L is negative.
    case.records[0] = (0, 0, 1, 0, 0, 0, 5, 0, 0, 0, 5, 0, 0, 0, 0, -0.1)
    alpha = _draw(case)[-1]
    assert alpha[:, 16:48].max() > 0.8
    assert not alpha[:, :16].any() and not alpha[:, 48:].any()


def test_weights_and_what_passes_sum_to_one_however_many_overlap(make_case):
    case = make_case("ewa", (8, 8), 20_000, opacity=(0.02, 1.5))
    case.records[:, 6:12] = 1e-3 * np.array((1, 0, 0, 0, 1, 0))
    case.values[:] = 0.7
    sums = _draw(case)
    np.testing.assert_allclose(sums[:-1], 0.7, atol=2e-6)
    np.testing.assert_allclose(sums[-1], 1, atol=1e-6)


def test_one_gaussian_too_wide_for_two_components_is_drawn_like_the_others(one_too_wide):
    np.testing.assert_allclose(_draw(one_too_wide), one_too_wide.dense()[0].numpy(), rtol=0, atol=2e-6)


_CHILD = """
import sys
import numpy as np
from pansplat.rendering.cpu.memory import Lease
from pansplat.rendering.cpu.raster import raster_forward, room_to_keep
from pansplat.rendering.cpu.raster_backward import raster_backward
from pansplat.rendering.cpu.tables import Plane
given = np.load(sys.argv[1])
plane = Plane(int(given["kind"]), given["columns"], given["rows"], given["rotation"])
drawn = [given[name] for name in ("records", "values", "entries", "starts")]
sums = np.zeros_like(given["grad_sums"])
lease = Lease()
kept = room_to_keep(given["starts"], lease)
raster_forward(*drawn, plane, sums, kept=kept)
grads = lease.array((len(drawn[2]), 16), np.float32), np.empty((len(drawn[2]), 4), np.float32)
raster_backward(*drawn, given["slots"], plane, sums, kept, given["grad_sums"], *grads)
np.savez(sys.argv[2], sums=sums, records=grads[0], values=grads[1])
"""


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["haswell", "x86-64"])
def test_processors_with_narrower_vectors_draw_the_same(processor, make_case, tmp_path):
    case = make_case("equirect", (40, 80), 200)
    upstream = np.random.default_rng(5).standard_normal((5, 40, 80)).astype(np.float32)
    plane = case.plane._asdict()
    drawn = {"records": case.records, "values": case.values, "entries": case.entries, "starts": case.starts}
    np.savez(tmp_path / "case.npz", **plane, **drawn, slots=case.slots, grad_sums=upstream)
    features = "" if processor != "haswell" else "+avx2,+fma,+bmi,+bmi2,+lzcnt,+popcnt"
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": processor,
        "NUMBA_CPU_FEATURES": features,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    files = tmp_path / "case.npz", tmp_path / "drawn.npz"
    subprocess.run([sys.executable, "-c", _CHILD, *map(str, files)], env=environment, check=True)
    drawn = np.load(files[1])
    sums, by_records, by_values = case.dense(upstream)
    np.testing.assert_allclose(drawn["sums"], sums.numpy(), rtol=0, atol=2e-6)
    for expected, slots in ((by_records, drawn["records"]), (by_values, drawn["values"])):
        error = case.reduce(slots) - expected.numpy()
        assert np.linalg.norm(error) <= 1e-5 * np.linalg.norm(expected)
