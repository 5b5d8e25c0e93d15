"""The front holds what nothing beats; the pictures appear whole or not at all."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pansplat.bench.plots import pareto_front, plot_choices, plot_sweeps
from pansplat.bench.rows import Row

NUMBER = st.integers(1, 6).map(float)


def row(suite: str, backend: str, milliseconds: float, psnr: float | None, **others) -> Row:
    known = {
        "scene": "room",
        "kernel": "ray",
        "order": "radial",
        "filter": "angular",
        "layout": "equirect",
        "height": 16,
        "face_size": None,
        "stitching": "seamless",
        "precision": "float32",
        "num_gaussians": 10,
        "threads": 1,
    }
    times = {"forward_ms": milliseconds, "forward_min_ms": milliseconds}
    return Row(suite=suite, backend=backend, psnr_db=psnr, **{**known, **times, **others})


def beats(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[0] and one[1] <= other[1] and one != other


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=20))
def test_the_front_is_exactly_what_no_other_point_beats(points):
    front = pareto_front(points)
    for index, point in enumerate(points):
        assert (index in front) == (not any(beats(other, point) for other in points))


@given(st.lists(st.tuples(NUMBER, NUMBER), min_size=1, max_size=20))
def test_along_the_front_time_rises_and_error_falls(points):
    front = [points[i] for i in pareto_front(points)]
    assert front == sorted(front, key=lambda p: (p[0], -p[1]))


def test_choices_are_drawn_with_and_without_an_error(tmp_path):
    rows = [row("choices", "numba", 5.0, 120.0), row("choices", "torch", 500.0, float("inf"), precision="float64")]
    rows.append(row("choices", "gl33", 50.0, 20.0, kernel="ewa", layout="cubemap", face_size=8, filter="3dgs"))
    assert plot_choices(rows, tmp_path / "choices.png")
    assert (tmp_path / "choices.png").read_bytes().startswith(b"\x89PNG")


def test_sweeps_are_drawn(tmp_path):
    rows = [row("count", "numba", 2.0, None), row("count", "numba", 4.0, None, num_gaussians=20, backward_min_ms=9.0)]
    rows += [replace(one, suite="resolution", height=16 * n) for n, one in enumerate(rows, 1)]
    assert plot_sweeps(rows, tmp_path / "sweeps.png")
    assert (tmp_path / "sweeps.png").stat().st_size > 1000


@pytest.mark.parametrize("plot", [plot_choices, plot_sweeps])
def test_nothing_measured_gives_no_picture(plot, tmp_path):
    assert not plot([row("dense", "numba", 5.0, None)], tmp_path / "none.png")
    assert not list(tmp_path.iterdir())
