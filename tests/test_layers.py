"""Imports only point down (.importlinter), and the check detects a violation."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# file, planted import, expected line of the report
PLANTS = [
    ("pansplat/errors.py", "import pansplat.geometry.pose", "pansplat.errors -> pansplat.geometry.pose"),
    (
        "pansplat/geometry/pose.py",
        "import pansplat.gaussians.ply",
        "pansplat.geometry.pose -> pansplat.gaussians.ply",
    ),
    (
        "pansplat/data/views.py",
        "import pansplat.gaussians.scene",
        "pansplat.data.views -> pansplat.gaussians.scene",
    ),
    (
        "pansplat/gaussians/ply.py",
        "import pansplat.data.views",
        "pansplat.gaussians.ply -> pansplat.data.views",
    ),
    (
        "pansplat/predictor.py",
        "import pansplat.rendering.blend",
        "pansplat.predictor -> pansplat.rendering.blend",
    ),
    ("pansplat/rendering/blend.py", "import pansplat.pipeline", "pansplat.rendering.blend -> pansplat.pipeline"),
    (
        "pansplat/pipeline.py",
        "import pansplat.evaluation.metrics",
        "pansplat.pipeline -> pansplat.evaluation.metrics",
    ),
    ("pansplat/evaluation/metrics.py", "import pansplat.cli", "pansplat.evaluation.metrics -> pansplat.cli"),
    ("pansplat/cli/render.py", "import pansplat_viewer", "pansplat.cli.render -> pansplat_viewer"),
    (
        "pansplat_viewer/app.py",
        "import pansplat.rendering.blend",
        "pansplat_viewer.app -> pansplat.rendering.blend",
    ),
]


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The packages under their import names, where imports can be planted."""
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "pansplat", tmp_path / "pansplat", ignore=ignore)
    shutil.copytree(ROOT / "viewer", tmp_path / "pansplat_viewer", ignore=ignore)
    shutil.copytree(ROOT / "shaders", tmp_path / "pansplat_viewer" / "shaders", ignore=ignore)
    return tmp_path


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    program = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    arguments = ["--config", str(ROOT / ".importlinter"), "--no-cache", "--no-logo"]
    environment = os.environ | {"PYTHONPATH": str(folder), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


def test_imports_only_point_down(copied: Path) -> None:
    done = lint(copied)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 kept, 0 broken" in done.stdout


def test_planted_upward_imports_are_caught(copied: Path) -> None:
    for file, planted, _ in PLANTS:
        with open(copied / file, "a") as source:
            source.write(f"\n{planted}\n")
    done = lint(copied)
    assert done.returncode != 0
    assert "0 kept, 2 broken" in done.stdout
    missed = [found for _, _, found in PLANTS if found not in done.stdout]
    assert not missed, done.stdout


def test_importing_pansplat_does_not_import_torch() -> None:
    program = "import sys, pansplat, pansplat.cli; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def test_public_names_are_callables_whatever_is_imported_first() -> None:
    program = (
        "import pansplat, pansplat.rendering.blend, pansplat.pipeline\n"
        "wrong = [name for name in pansplat.__all__ if not callable(getattr(pansplat, name))]\n"
        "assert not wrong, wrong\n"
        "assert pansplat.render is pansplat.pipeline.render\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
