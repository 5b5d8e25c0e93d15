"""The viewer's benchmark: errors against float64, and its files."""

import json
import os

import pytest
from refusals import expect_error

from pansplat.bench import viewer
from pansplat.bench.viewer import list_viewer_cases, measure_viewer
from pansplat.cli import run

CASES = [case for case in list_viewer_cases((64, 48)) if case.view == "perspective"]


@pytest.mark.slow
@pytest.mark.gl
def test_the_viewer_renders_the_exact_images_and_the_command_writes_rows_page_and_plot(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(viewer, "list_viewer_cases", lambda *_: CASES)
    command = ["bench", "viewer", "--heights", "16", "--size", "64", "64", "--quick", "--out", str(tmp_path)]
    if run(command) != 0:
        error = capsys.readouterr().err
        assert "OpenGL" in error and not os.environ.get("CI"), error
        pytest.skip(error)
    rows = json.loads((tmp_path / "viewer.json").read_text())["rows"]
    assert [(row["renderer"], row["mode"]) for row in rows] == [(case.renderer, case.mode) for case in CASES]
    for row in rows:
        assert row["psnr_db"] > 60 and row["best_ms"] <= row["frame_ms"] and row["device"]
    assert "| cpu |" in (tmp_path / "viewer.md").read_text()
    assert (tmp_path / "viewer.png").stat().st_size > 5000
    (tmp_path / "job.json").write_text("{}")
    expect_error("the viewer rendered nothing: error: 'scene'", viewer.run_viewer, tmp_path / "job.json", 1)
    monkeypatch.setattr(viewer, "_VIEWER_PACKAGE", "no_such_package")
    expect_error("viewer is not installed", lambda: list(measure_viewer(16, CASES, repeats=1, threads=1)))
