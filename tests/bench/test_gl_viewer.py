"""The viewer's rows are those of the choices it was asked for; without it or OpenGL a message says so."""

import os

import pytest

from pansplat.bench import gl_viewer
from pansplat.bench.cases import Case, Group
from pansplat.bench.gl_viewer import measure_viewer
from pansplat.bench.plan import room
from pansplat.bench.raster import Bench
from pansplat.errors import InputError

HEIGHT = 16


def group(*kernels: str) -> Group:
    cases = [Case("gl", HEIGHT, kernel, layout="cubemap", face_size=10, threads=2) for kernel in kernels]
    return Group("choices", room(HEIGHT), tuple(cases), "own")


@pytest.mark.gl
def test_rows_of_the_viewer_are_right():
    bench = Bench({})
    try:
        measure_viewer(bench, group("ray", "ewa"), repeats=2)
    except InputError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    rows = [row for row in bench.rows if row.backend == "gl33"]
    assert [row.kernel for row in rows] == ["ray", "ewa"]
    for row in rows:
        assert row.forward_ms > 0 and row.repeats == 2 and row.backward_ms is None
        assert row.own_max_error < 5e-3 and row.num_gaussians == 862
        assert set(row.stages_ms) == {"sort", "draw"} and row.note.startswith("drawn by ")
    assert rows[0].max_error < rows[1].max_error


def test_a_viewer_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(gl_viewer, "_PROGRAM", "no_such_viewer")
    with pytest.raises(InputError, match="not installed"):
        measure_viewer(Bench({}), group("ray"), repeats=1)


def test_a_viewer_that_fails_is_told_in_its_own_words(monkeypatch, tmp_path):
    (tmp_path / "job.json").write_text("{}")
    with pytest.raises(InputError, match="the viewer drew nothing: error: 'scene'"):
        list(gl_viewer._lines(tmp_path / "job.json", 1))
