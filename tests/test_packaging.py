"""The wheel contains both packages and nothing else, and works without the checkout and with its dependencies alone."""

import importlib.metadata
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement
from synthetic_scenes import make_balls

import pansplat
from pansplat.gaussians.ply import save_ply
from pansplat.gaussians.scene import Scene
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.images.video import open_video
from pansplat.system.source_hash import hash_sources

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

pytestmark = pytest.mark.lint

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = ".py .json .glsl .vert .frag .geom .comp .safetensors .html .css .js"
FOLDERS = {
    "pansplat": "pansplat",
    "pansplat.default_model": "assets/default",
    "pansplat.matcher": "assets/matcher",
    "pansplat.shaders": "shaders",
    "pansplat_viewer": "viewer",
}


def read_project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def list_instructions(name: str) -> list[str]:
    """The arguments of an instruction of the Dockerfile."""
    text = (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ")
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    return [value for instruction, value in lines if instruction == name]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the files that the Dockerfile copies, and from tests, which it must not contain."""
    source = tmp_path_factory.mktemp("source")
    for copied in (*list_instructions("COPY"), "tests tests"):
        *names, target = [word for word in shlex.split(copied) if not word.startswith("--")]
        for path in (ROOT / name for name in names):
            if path.is_dir():
                shutil.copytree(path, source / target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(path, source / target)
    build = [sys.executable, "-m", "build", "--no-isolation", "."]  # the wheel of the source distribution
    done = subprocess.run(build, cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (file,) = (source / "dist").glob("*.whl")
    return file


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed wheel, as site-packages."""
    site = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "-qq", "--target", str(site), str(wheel)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return site


def run_in(site: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a command with the installed wheel ahead of this checkout's editable install."""
    environment = os.environ | {"PYTHONPATH": str(site)}
    return subprocess.run(command, cwd=site.parent, env=environment, capture_output=True, text=True)


def test_the_package_list_equals_the_packages_on_disk() -> None:
    on_disk = {".".join(file.parent.relative_to(ROOT).parts) for file in (ROOT / "pansplat").rglob("__init__.py")}
    on_disk |= {"pansplat.default_model", "pansplat.matcher", "pansplat.shaders", "pansplat_viewer"} | {
        "pansplat_viewer." + ".".join(file.parent.relative_to(ROOT / "viewer").parts)
        for file in (ROOT / "viewer").glob("*/**/__init__.py")
    }
    listed = read_project()["tool"]["setuptools"]["packages"]
    assert sorted(listed) == sorted(on_disk)
    assert len(set(listed)) == len(listed)


def test_the_wheel_contains_every_module_and_shader_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    version = read_project()["project"]["version"]
    assert version == pansplat.__version__
    assert {name.split("/")[0] for name in names} == {"pansplat", "pansplat_viewer", f"pansplat-{version}.dist-info"}
    assert not [name for name in names if "test_" in name or "conftest" in name or "__pycache__" in name]
    needed = {"pansplat/py.typed"}
    for package, folder in FOLDERS.items():
        for file in (ROOT / folder).rglob("*"):
            if file.suffix in SUFFIXES.split():
                needed.add(f"{package.replace('.', '/')}/{file.relative_to(ROOT / folder).as_posix()}")
    assert not needed - set(names)
    assert any(name.endswith((".frag", ".glsl")) for name in needed)


def test_an_installed_wheel_reads_its_own_shaders(installed: Path) -> None:
    program = (
        "import pansplat, pansplat_viewer, pathlib, sys\n"
        "from importlib.resources import files\n"
        "site = pathlib.Path(sys.argv[1])\n"
        "assert pathlib.Path(pansplat.__file__).is_relative_to(site), pansplat.__file__\n"
        "assert pathlib.Path(pansplat_viewer.__file__).is_relative_to(site)\n"
        "from pansplat.shaders import load_shader\n"
        "shaders = [f.name for f in files('pansplat.shaders').iterdir() if f.name.endswith('.frag')]\n"
        "assert shaders and all(load_shader(name, '330 core') for name in shaders)\n"
    )
    done = run_in(installed, sys.executable, "-c", program, str(installed))
    assert done.returncode == 0, done.stderr


def test_an_installed_wheel_has_the_hashes_of_sources_of_the_checkout(installed: Path) -> None:
    modules = ("pansplat.sweep.guided_sweep", "pansplat.refinement", "pansplat.poses.files", "pansplat.model.network")
    program = f"from pansplat.system.source_hash import hash_sources; print(*map(hash_sources, {modules}))"
    done = run_in(installed, sys.executable, "-c", program)
    assert done.stdout.split() == [hash_sources(module) for module in modules], done.stderr


@pytest.mark.parametrize(
    "command", sorted({"pansplat", "pansplat-view", "pansplat-train", *json.loads(list_instructions("ENTRYPOINT")[0])})
)
def test_the_entry_points_of_an_installed_wheel_work(installed: Path, command: str) -> None:
    done = run_in(installed, sys.executable, str(installed / "bin" / command), "--help")
    assert done.returncode == 0, done.stderr
    assert command in done.stdout + done.stderr


def find_foreign_modules() -> list[str]:
    """The modules here that neither the wheel nor its dependencies need, except those of installation."""
    waiting, needed = list(read_project()["project"]["dependencies"]), set()
    while waiting:
        requirement = Requirement(waiting.pop())
        name = re.sub("[-_.]+", "-", requirement.name).lower()
        if (requirement.marker is None or requirement.marker.evaluate({"extra": ""})) and name not in needed:
            needed.add(name)
            waiting += importlib.metadata.requires(name) or []
    modules = importlib.metadata.packages_distributions().items()
    foreign = [
        module
        for module, owners in modules
        if not needed & {re.sub("[-_.]+", "-", owner).lower() for owner in owners} and not module.startswith("pansplat")
    ]
    return [module for module in foreign if module not in ("_distutils_hack", "pip", "setuptools")]


def test_an_installed_wheel_needs_its_dependencies_only(installed: Path, tmp_path: Path) -> None:
    """As in a clean environment: a scene is drawn to files while all other packages cannot be imported."""
    foreign = find_foreign_modules()
    assert {"pytest", "beartype", "distributed"} <= set(foreign) and not {"torch", "llvmlite", "PIL"} & set(foreign)
    directions = fibonacci_directions(200).float()
    gaussians = make_balls(2 * directions, 0.1, harmonics=directions[:, None])
    save_ply(
        Scene(gaussians, torch.eye(4, dtype=torch.float64)[None], 0.5, 10.0, ("a",), "", 32), tmp_path / "scene.ply"
    )
    program = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(sys.argv.pop(1).split(',')))\n"
        "import pansplat_viewer\n"
        "sys.exit(pansplat_viewer.main())\n"
    )
    options = ["--offscreen", str(tmp_path / "out"), "--size", "64x32", "--seconds", "0.1"]
    command = [sys.executable, "-c", program, ",".join(foreign), str(tmp_path / "scene.ply"), *options]
    done = run_in(installed, *command)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(open_video(tmp_path / "out" / "flythrough.mp4").stamps) > 1


def test_tests_pass_against_the_installed_wheel(installed: Path) -> None:
    """Run the tests of one module with the wheel instead of the checkout."""
    options = ["-q", "-n", "0", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml")]
    done = run_in(installed, sys.executable, "-m", "pytest", *options, str(ROOT / "tests/gaussians/test_ply.py"))
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout


def test_setup_pins_every_direct_dependency() -> None:
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    assert "torch==2.13.0" in constraints
    pinned = {line.split("==")[0] for line in constraints if line and not line.startswith("#")}
    metadata = read_project()["project"]
    requirements = [*metadata["dependencies"], *metadata["optional-dependencies"]["dev"]]
    names = {re.split("[;>=[]", name)[0].strip().lower().replace("_", "-") for name in requirements}
    assert not names - pinned
    assert subprocess.run(["bash", "-n", str(ROOT / "setup.sh")]).returncode == 0
