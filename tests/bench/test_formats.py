"""The benchmark of file formats: errors by field and of images."""

import dataclasses
import math

import pytest
import torch

from pansplat.bench.formats import make_format_table, measure_formats, set_degree
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


@pytest.mark.slow
def test_lossy_formats_are_smaller_and_lossless_ones_exact(scene: Scene) -> None:
    rows = {row.suffix: row for row in measure_formats(scene, 16)}
    assert set(rows) == set(SCENE_SUFFIXES)
    for suffix in (".ply", ".glb"):
        assert rows[suffix].position_mm < 1e-3 and rows[suffix].psnr_db > 90
    for suffix in (".spz", ".splat", ".sog", ".compressed.ply"):
        assert 30 < rows[suffix].psnr_db < 90 and math.isnan(rows[suffix].harmonics)
    assert rows[".splat"].bytes == 32 * 50
    assert 0.01 < rows[".spz"].position_mm < 0.25
    assert make_format_table(list(rows.values()), "x").row_count == 6


def test_a_higher_degree_adds_random_harmonics(scene: Scene) -> None:
    richer = set_degree(scene, 2)
    assert richer.gaussians.degree == 2
    assert torch.equal(richer.gaussians.harmonics[:, 0], scene.gaussians.harmonics[:, 0])
    assert 0.03 < float(richer.gaussians.harmonics[:, 1:].std()) < 0.07
    assert set_degree(richer, 0).gaussians.degree == 0
    with pytest.warns(InputWarning, match="up to degree 0"):
        rows = {row.suffix: row for row in measure_formats(dataclasses.replace(richer), 16)}
    assert 0 < rows[".compressed.ply"].harmonics < 0.01
