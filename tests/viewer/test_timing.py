"""The timing command draws what the renderer draws, and says in plain JSON how long it took."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from pansplat.gaussians.ply import save_ply
from pansplat.rendering import rasterize

pytestmark = pytest.mark.gl

SETTINGS = [
    {"kernel": "ray", "layout": "equirect", "face_size": 16},
    {"kernel": "ewa", "order": "z", "lowpass": "3dgs"},
]


@pytest.fixture
def job(ctx, random_scene, pose, tmp_path):
    scene = random_scene(100)
    save_ply(scene, tmp_path / "scene.ply")
    values = {
        "scene": str(tmp_path / "scene.ply"),
        "pose": pose.tolist(),
        "size": [48, 24],
        "repeats": 3,
        "folder": str(tmp_path),
        "tiers": ["gl33", "gl43"],
        "settings": SETTINGS,
    }
    (tmp_path / "job.json").write_text(json.dumps(values))
    return tmp_path / "job.json", scene


def timed(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pansplat_viewer.timing", *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_lines_hold_times_and_the_references_picture(job, pose):
    file, scene = job
    done = timed(str(file))
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["settings"] for line in lines[:2]] == [0, 1]
    assert lines[0]["tier"] == "gl33" and lines[0]["renderer"]
    for line in lines:
        assert len(line["frame_ms"]) == 3 and min(line["frame_ms"]) > 0 <= line["sort_ms"]
    expected = rasterize(
        scene.gaussians.to(dtype=torch.float64),
        torch.from_numpy(pose),
        size=(24, 48),
        layout="cubemap",
        face_size=16,
    )
    drawn = np.load(lines[0]["image"])[..., :3].transpose(2, 0, 1)
    assert np.abs(drawn - expected.color.numpy()).max() <= 5e-3


@pytest.mark.parametrize(
    "content", ["{}", "no json", '{"scene": "none.ply", "pose": 0, "settings": [{"kernel": "x"}]}']
)
def test_a_job_that_cannot_be_used_ends_with_one_line(content, tmp_path):
    (tmp_path / "job.json").write_text(content)
    done = timed(str(tmp_path / "job.json"))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: ") and "Traceback" not in done.stderr
