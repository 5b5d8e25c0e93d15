"""Hashes of source code follow imports."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pansplat.poses.files import _hash_inputs
from pansplat.refinement import refinement_fingerprint
from pansplat.sweep import Sweep
from pansplat.system import source_hash
from pansplat.system.source_hash import hash_sources, list_imports

PACKAGE = Path(source_hash.__file__).parents[1]


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """A copy of the package's sources, which fingerprints read."""
    for source in PACKAGE.rglob("*.py"):
        copy = tmp_path / source.relative_to(PACKAGE)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, copy)
    monkeypatch.setattr(source_hash, "_FOLDER", tmp_path)
    hash_sources.cache_clear()
    yield tmp_path
    hash_sources.cache_clear()


def change(source: Path) -> None:
    with source.open("a") as file:
        file.write("# another line\n")
    hash_sources.cache_clear()


FINGERPRINTS = {
    "sweep": lambda: Sweep().fingerprint,
    "default": lambda: hash_sources("pansplat.sweep.guided_sweep"),
    "network": lambda: hash_sources("pansplat.model.network"),
    "refinement": refinement_fingerprint,
    "pixels": lambda: hash_sources("pansplat.inputs.panorama_sets"),
    "poses": lambda: _hash_inputs([], 1.5),
}
SOURCES = {
    "sweep": ("rendering/cpu/rasterize.py", "geometry/world.py", "images/masks.py"),
    "refinement": ("rendering/reference.py", "rendering/cuda/rasterize.py", "refinement/fusion.py"),
    "default": ("sweep/guided_sweep.py", "networks/layers.py"),
    "network": ("model/heads.py", "gaussians/harmonics.py", "predictor.py"),
    "pixels": ("images/image_files.py", "images/blur_masks.py", "images/cube_images.py"),
    "poses": ("poses/two_view.py", "networks/lightglue.py", "sweep/prior.py"),
}


@pytest.mark.parametrize("result", FINGERPRINTS)
def test_a_fingerprint_changes_with_each_source_that_computes_the_result_and_with_no_command(copied, result):
    hashes = [FINGERPRINTS[result]()]
    for source in SOURCES[result]:
        change(copied / source)
        hashes.append(FINGERPRINTS[result]())
    assert len(set(hashes)) == len(hashes)
    for source in ("cli/render.py", "__init__.py", "pipeline/prediction.py"):
        change(copied / source)
    assert FINGERPRINTS[result]() == hashes[-1]


def test_the_folder_and_the_ends_of_lines_do_not_change_a_hash(copied):
    in_copy = hash_sources("pansplat.refinement")
    for source in copied.rglob("*.py"):
        source.write_bytes(source.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", b"\r\n"))
    hash_sources.cache_clear()
    with_carriage_returns = hash_sources("pansplat.refinement")
    program = "from pansplat.system.source_hash import hash_sources; print(hash_sources('pansplat.refinement'))"
    original = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert [in_copy, with_carriage_returns] == [original.stdout.strip()] * 2


def test_imports_of_imports_count_and_strangers_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr(source_hash, "_FOLDER", tmp_path)
    (tmp_path / "upper.py").write_text("from pansplat import middle as m, other\n")
    (tmp_path / "middle.py").write_text(
        "def f():\n    from pansplat.lower import (  # (late)\n        a,\n        b,\n    )\n"
    )
    for name in ("lower", "other", "stranger"):
        (tmp_path / f"{name}.py").write_text("a = 1\n")

    def compute(*prefixes: str) -> str:
        hash_sources.cache_clear()
        return hash_sources("pansplat.upper", prefixes or ("pansplat.",))

    hashes, restricted = [compute()], [compute("pansplat.middle")]
    for name in ("lower", "other", "stranger"):
        (tmp_path / f"{name}.py").write_text("a = 2\n")
        hashes.append(compute())
        restricted.append(compute("pansplat.middle"))
    assert len(set(hashes[:3])) == 3 and hashes[2] == hashes[3] and len(set(restricted)) == 1
    hash_sources.cache_clear()


def test_all_imports_of_the_syntax_tree_are_listed():
    for source in PACKAGE.rglob("*.py"):
        text, expected = source.read_text("utf-8"), set()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import):
                expected |= {alias.name for alias in node.names if source_hash._find(alias.name)}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, "hashes of sources follow absolute imports only"
                known = node.module or ""
                members = [f"{known}.{alias.name}" for alias in node.names if source_hash._find(known)]
                expected |= {member if source_hash._find(member) else known for member in members}
        assert expected <= list_imports(text) | {"pansplat"}, source
