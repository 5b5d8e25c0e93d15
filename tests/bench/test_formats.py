"""The benchmark of file formats: errors by field and of images."""

import json
from pathlib import Path

import pytest
import torch

from pansplat import pipeline
from pansplat.bench import formats
from pansplat.bench.report import Report
from pansplat.cli import run
from pansplat.errors import InputWarning
from pansplat.files import SCENE_SUFFIXES
from pansplat.gaussians.scene import Gaussians, Scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    random = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        means=torch.randn(50, 3, generator=random) * 2,
        scales=torch.rand(50, 3, generator=random) * 0.2 + 0.05,
        quats=torch.randn(50, 4, generator=random),
        opacities=torch.rand(50, generator=random) * 0.9 + 0.05,
        harmonics=torch.randn(50, 1, 3, generator=random) * 0.5,
        levels=torch.zeros(50, dtype=torch.int64),
        views=torch.arange(50) % 2,
    )
    return Scene(gaussians, torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), near=0.1, far=10.0, height=16)


def test_lossy_formats_are_smaller_and_lossless_ones_exact(scene: Scene, tmp_path: Path) -> None:
    file, out = tmp_path / "scene.ply", tmp_path / "out"
    pipeline.save(scene, file)
    assert run(["bench", "formats", str(file), "--height", "16", "--out", str(out), "--threads", "1"]) == 0
    rows = {row["suffix"]: row for row in json.loads((out / "formats.json").read_text())["rows"]}
    assert set(rows) == set(SCENE_SUFFIXES)
    for suffix in (".ply", ".glb"):
        assert rows[suffix]["position_mm"] < 1e-3 and (rows[suffix]["psnr_db"] or 999) > 90
    for suffix in (".spz", ".splat", ".sog", ".compressed.ply"):
        assert 30 < rows[suffix]["psnr_db"] < 90 and "harmonics" not in rows[suffix]
    assert rows[".splat"]["bytes"] == 32 * 50
    assert 0.01 < rows[".spz"]["position_mm"] < 0.25
    assert len((out / "formats.md").read_text().splitlines()) == 5 + len(rows)
    assert "### Scene.ply: 50 Gaussians" in (out / "formats.md").read_text() and (out / "formats.png").is_file()


def test_a_higher_degree_adds_random_harmonics(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    richer = formats.set_degree(scene, 2)
    assert richer.gaussians.degree == 2
    assert torch.equal(richer.gaussians.harmonics[:, 0], scene.gaussians.harmonics[:, 0])
    assert 0.03 < float(richer.gaussians.harmonics[:, 1:].std()) < 0.07
    assert formats.set_degree(richer, 0).gaussians.degree == 0
    monkeypatch.setattr(formats, "_FORMATS", (".ply", ".compressed.ply", ".splat"))
    report = Report(formats.FORMATS, {})
    with pytest.warns(InputWarning, match="up to degree 0"):
        formats.measure_formats(richer, 16, report)
    ply, compressed, splat = (row.get("harmonics") for row in report.rows)
    assert 0 < compressed < 0.01 and ply < 1e-6 and splat is None
