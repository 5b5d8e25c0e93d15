"""`pansplat export`: files, refused arguments."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pansplat import pipeline
from pansplat.cli import run


def test_a_scene_is_written_pruned(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.ply"
    assert run(["export", str(scene), "-o", str(out), "--min-opacity", "0.95"]) == 0
    assert "0 Gaussians" in capsys.readouterr().out
    assert len(pipeline.load(out).gaussians) == 0
    assert run(["export", str(scene), "-o", str(out)]) == 0
    assert out.read_bytes() == scene.read_bytes()


def test_points_have_the_means_and_the_colours(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "points.ply"
    assert run(["export", str(scene), "-o", str(out), "--points"]) == 0
    header, body = out.read_bytes().split(b"end_header\n")
    assert b"property float x" in header and b"property uchar blue" in header
    points = np.frombuffer(body, [("position", "<f4", 3), ("color", "u1", 3)])
    gaussians = pipeline.load(scene).gaussians
    assert np.array_equal(points["position"], gaussians.means.numpy())
    colors = 255 * (0.5 + 0.28209479 * gaussians.harmonics[:, 0].numpy())
    assert np.abs(points["color"] - colors.clip(0, 255)).max() <= 0.51


def test_an_unknown_suffix_names_the_known_ones(scene: Path, tmp_path: Path, refusal: Callable[..., str]) -> None:
    message = refusal("export", scene, "-o", tmp_path / "scene.obj")
    assert ".ply" in message and "scene.obj" in message
