"""The viewer's benchmark: cases, errors against float64, and its files."""

import json
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from pansplat.bench import viewer
from pansplat.bench.viewer import VIEWER, ViewerCase, list_viewer_cases, measure_viewer
from pansplat.cli import run
from pansplat.errors import InputError
from pansplat.evaluation.results import Row
from pansplat.gaussians.ply import load_ply
from pansplat.rendering import rasterize

HEADER = {"machine": {"cpu": "some", "gpu": None, "threads": 1}}


@pytest.fixture
def jobs(monkeypatch) -> list[dict]:
    """Jobs given to the viewer, which is replaced by numba for joint images and by black for others."""
    jobs = []

    def run_viewer(file: Path, threads: int) -> list[str]:
        job = json.loads(file.read_text())
        jobs.append(job)
        gaussians, lines = load_ply(job["scene"]).gaussians, []
        for index, settings in enumerate(job["settings"]):
            width, height = settings["size"]
            image = np.zeros((height, width, 4), np.float32)
            if settings["mode"] == "joint" and settings.get("layout") != "equirect":
                drawn = rasterize(
                    gaussians, torch.tensor(job["pose"]), size=(height, width), layout="pinhole",
                    vertical_fov_degrees=settings["vertical_fov_degrees"], backend="numba",
                )  # fmt: skip
                image[..., :3] = drawn.color.permute(1, 2, 0).numpy()
            path = file.parent / f"{index}.npy"
            np.save(path, image)
            times = [3.0, 1.0, 2.0]
            line = {
                "settings": index, "renderer": job["renderers"][0], "frame_ms": times, "sort_ms": 0.5,
                "stages": {"sort": 0.5, "draw": 1.5}, "image": str(path), "device": "fake",
            }  # fmt: skip
            lines.append(json.dumps(line))
        return lines

    monkeypatch.setattr(viewer, "run_viewer", run_viewer)
    monkeypatch.setattr(viewer, "_PANORAMA_SIZE", (16, 8))  # a float64 image of the usual size takes seconds
    return jobs


def test_each_renderer_moves_and_turns_in_both_modes():
    cases = list_viewer_cases((128, 64))
    assert len(set(cases)) == len(cases)
    for renderer in ("cpu", "gl"):
        of_renderer = {(case.view, case.mode) for case in cases if case.renderer == renderer}
        assert {("perspective", "deferred"), ("look-around", "joint"), ("panorama", "joint")} <= of_renderer
    coarse = [case for case in cases if case.view == "coarse"]
    assert {(case.renderer, case.width, case.height) for case in coarse} == {("cpu", 64, 32)}


def test_the_command_writes_rows_page_and_plot(jobs, tmp_path):
    command = ["bench", "viewer", "--heights", "16", "--size", "64", "64", "--out", str(tmp_path), "--threads", "1"]
    assert run(command) == 0
    rows = json.loads((tmp_path / "viewer.json").read_text())["rows"]
    assert len(rows) == len(list_viewer_cases((64, 64)))
    assert {row["frame_ms"] for row in rows} == {2.0}
    joint = [row for row in rows if row["mode"] == "joint" and row["view"] == "perspective"]
    assert len(joint) == 2 and all(row["psnr_db"] > 100 for row in joint), "the same image"
    assert next(row["psnr_db"] for row in rows if row["mode"] == "deferred") < 30, "another image"
    page = (tmp_path / "viewer.md").read_text()
    assert "deferred blending takes 1.00 times" in page and "sort 0.5, draw 1.5" in page
    assert (tmp_path / "viewer.png").stat().st_size > 5000
    assert len(jobs) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--heights", "20"], "multiple of 8"), (["--size", "8", "8"], "--size, [0]: needed a whole number >= 64")],
)
def test_invalid_arguments_are_refused(arguments, message, capsys):
    assert run(["bench", "viewer", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_without_the_viewer_the_error_says_so(monkeypatch):
    monkeypatch.setattr(viewer, "_VIEWER_PACKAGE", "no_such_package")
    with pytest.raises(InputError, match="viewer is not installed"):
        list(measure_viewer(16, list_viewer_cases((64, 64)), repeats=1, threads=1))


def test_findings_and_plot_need_no_complete_rows():
    case, times = asdict(ViewerCase("cpu", "perspective", "joint", 64, 64)), ("frame_ms", "best_ms", "num_gaussians")
    rows = [Row({"scene": "room 16", **case}, dict(zip(times, (11.0, 10.0, 500), strict=True)))]
    assert VIEWER.findings(rows) == []
    slow = dict(zip(times, (45.0, 40.0, 500), strict=True))
    rows.append(Row({"scene": "room 16", **case, "renderer": "gl"}, slow))
    assert VIEWER.findings(rows) == ["500 Gaussians: cpu draws a frame in 10 ms, OpenGL in 40 ms."]
    assert len(viewer.plot_viewer(rows, HEADER).axes) == 1


@pytest.mark.slow
@pytest.mark.gl
def test_the_viewer_renders_the_exact_images(tmp_path):
    cases = [case for case in list_viewer_cases((64, 48), ("cpu", "gl")) if case.view == "perspective"]
    try:
        rows = list(measure_viewer(16, cases, repeats=2, threads=2))
    except InputError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))
    assert [(row.get("renderer"), row.get("mode")) for row in rows] == [(case.renderer, case.mode) for case in cases]
    for row in rows:
        assert row.get("psnr_db") > 60 and row.get("best_ms") <= row.get("frame_ms") and row.get("device")
    (tmp_path / "job.json").write_text("{}")
    with pytest.raises(InputError, match="the viewer rendered nothing: error: 'scene'"):
        viewer.run_viewer(tmp_path / "job.json", 1)
