"""The timing command writes the renderer's images, and its times as JSON."""

import json
import sys

import numpy as np
import pytest
import torch

from pansplat.gaussians.ply import save_ply
from pansplat.rendering import rasterize
from pansplat_viewer.draw.timing import main

pytestmark = pytest.mark.gl


@pytest.fixture
def run_job(tmp_path, monkeypatch, capsys):
    """Runs the command in this process; returns status, output and errors."""

    def run(content: str) -> tuple[int, str, str]:
        (tmp_path / "job.json").write_text(content)
        monkeypatch.setattr(sys, "argv", ["timing", str(tmp_path / "job.json")])
        return main(), *capsys.readouterr()

    return run


def test_lines_have_times_and_the_image_of_the_reference(run_job, random_scene, pose, tmp_path):
    scene = random_scene(100)
    save_ply(scene, tmp_path / "scene.ply")
    job = {
        "scene": str(tmp_path / "scene.ply"),
        "pose": pose.tolist(),
        "size": [48, 24],
        "repeats": 3,
        "folder": str(tmp_path),
        "renderers": ["gl", "cpu"],
        "settings": [
            {"layout": "equirect", "size": [192, 96]},
            {"mode": "deferred"},
            {"cached": True, "size": [64, 32]},
        ],
    }
    status, output, errors = run_job(json.dumps(job))
    assert status == 0, errors
    lines = [json.loads(line) for line in output.splitlines()]
    assert [line["settings"] for line in lines[:3]] == [0, 1, 2]
    assert np.load(lines[2]["image"]).shape == (32, 64, 4)
    assert lines[0]["renderer"] == "gl" and lines[0]["device"]
    for line in lines:
        assert len(line["frame_ms"]) == 3 and "sort_ms" in line
    cpu = [line for line in lines if line["renderer"] == "cpu"]
    assert {"project", "rasterize", "blend"} <= set(cpu[0]["stages"]) and "sample" in cpu[2]["stages"]
    for line in cpu:
        difference = np.load(line["image"])[..., :3] - np.load(lines[line["settings"]]["image"])[..., :3]
        assert np.abs(difference).mean() <= 6e-3
    gaussians = scene.gaussians.to(dtype=torch.float64)
    expected = rasterize(gaussians, torch.from_numpy(pose), size=(96, 192), layout="cubemap")
    drawn = np.load(lines[0]["image"])[..., :3].transpose(2, 0, 1)
    assert np.abs(drawn - expected.color.numpy()).max() <= 5e-3


@pytest.mark.parametrize(
    "content", ["{}", "no json", '{"scene": "none.ply", "pose": 0, "settings": [{"preset": "x"}]}']
)
def test_invalid_job_ends_with_one_line(run_job, content):
    status, output, errors = run_job(content)
    assert status == 2 and output == ""
    assert errors.startswith("error: ") and errors.count("\n") == 1
