"""Modules import lower layers only (.importlinter) and no recipe, and the checks report violations."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.lint

# module, import of a higher layer
VIOLATIONS = [
    ("pansplat.errors", "pansplat.geometry.pose"),
    ("pansplat.geometry.pose", "pansplat.gaussians.ply"),
    ("pansplat.inputs.views", "pansplat.gaussians.scene"),
    ("pansplat.gaussians.ply", "pansplat.inputs.views"),
    ("pansplat.predictor", "pansplat.rendering.blend"),
    ("pansplat.rendering.blend", "pansplat.pipeline"),
    ("pansplat.pipeline", "pansplat.evaluation.metrics"),
    ("pansplat.evaluation.metrics", "pansplat.cli"),
    ("pansplat.cli.render", "pansplat_viewer"),
    ("pansplat_viewer.app", "pansplat.evaluation.metrics"),
]


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the packages under their import names, to which imports can be added."""
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "pansplat", tmp_path / "pansplat", ignore=ignore)
    shutil.copytree(ROOT / "viewer", tmp_path / "pansplat_viewer", ignore=ignore)
    shutil.copytree(ROOT / "shaders", tmp_path / "pansplat" / "shaders", ignore=ignore)
    return tmp_path


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    program = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    arguments = ["--config", str(ROOT / ".importlinter"), "--no-cache", "--no-logo"]
    environment = os.environ | {"PYTHONPATH": str(folder), "COLUMNS": "200"}
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def test_modules_import_lower_layers_only(copied: Path) -> None:
    done = lint(copied)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 kept, 0 broken" in done.stdout


def test_upward_imports_are_reported(copied: Path) -> None:
    for module, forbidden in VIOLATIONS:
        with open(copied / f"{module.replace('.', '/')}.py", "a") as source:
            source.write(f"\nimport {forbidden}\n")
    done = lint(copied)
    assert done.returncode != 0
    assert "0 kept, 2 broken" in done.stdout
    missed = [violation for violation in VIOLATIONS if " -> ".join(violation) not in done.stdout]
    assert not missed, done.stdout


def find_imports_of_recipes(folder: Path) -> list[str]:
    """The Python files of a folder that import a package of assets/recipe."""
    pattern = re.compile(r"^\s*(?:from|import) pansplat_homes\b", re.MULTILINE)
    files = sorted(folder.rglob("*.py"))
    return [file.relative_to(folder).as_posix() for file in files if pattern.search(file.read_text("utf-8"))]


def test_only_recipes_import_recipes(copied: Path) -> None:
    assert find_imports_of_recipes(copied) == find_imports_of_recipes(ROOT / "tests") == []
    with open(copied / "pansplat" / "training" / "datasets.py", "a") as source:
        source.write("\nfrom pansplat_homes.triplets import GeneratedTriplets\n")
    assert find_imports_of_recipes(copied) == ["pansplat/training/datasets.py"]
    assert find_imports_of_recipes(ROOT / "assets" / "recipe"), "the recipe is found under its name"


def test_public_names_are_callable_after_an_import_of_submodules() -> None:
    program = (
        "import pansplat, pansplat.rendering.blend, pansplat.pipeline\n"
        "wrong = [name for name in pansplat.__all__ if not callable(getattr(pansplat, name))]\n"
        "assert not wrong, wrong\n"
        "assert pansplat.render is pansplat.pipeline.render\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_architecture_names_every_module() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    rows = {names: row for row in text.splitlines() for names in re.findall(r"^\| `([a-z_/]+)/`", row)}
    missing = []
    for source in (*(ROOT / "pansplat").rglob("*.py"), *(ROOT / "viewer").rglob("*.py")):
        folder = source.relative_to(ROOT).parent.as_posix().removeprefix("pansplat/")
        parts = [row for name, row in rows.items() if folder == name or folder.startswith(f"{name}/")]
        described = "".join(parts) or (text if folder == "pansplat" else "")
        if source.name != "__init__.py" and not re.search(rf"\b{source.stem}\b", described):
            missing.append(source.relative_to(ROOT).as_posix())
    assert not missing, missing
