"""The wheel contains both packages and nothing else, and works in an environment with its dependencies alone."""

import importlib.metadata
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path

import av
import pytest
import torch
from packaging.requirements import Requirement
from synthetic_scenes import make_balls

import pansplat
from pansplat.gaussians.ply import save_ply
from pansplat.gaussians.scene import Scene
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.system.source_hash import hash_sources

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]
SUFFIXES = [".py", ".json", ".glsl", ".vert", ".frag", ".safetensors", ".html", ".css", ".js"]
FOLDERS = {
    "pansplat": "pansplat",
    "pansplat/default_model": "assets/default",
    "pansplat/matcher": "assets/matcher",
    "pansplat/shaders": "shaders",
    "pansplat_viewer": "viewer",
}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def list_instructions(name: str) -> list[str]:
    """The arguments of an instruction of the Dockerfile."""
    text = (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ")
    lines = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    return [value for instruction, value in lines if instruction == name]


def run_in(folder: Path, *command: str | Path) -> str:
    """The output of a command that succeeds in a folder, without modules of this checkout."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the sdist of the files that the Dockerfile copies, and of tests, which it must not contain."""
    source = tmp_path_factory.mktemp("source")
    for copied in (*list_instructions("COPY"), "tests tests"):
        *names, target = [word for word in shlex.split(copied) if not word.startswith("--")]
        for path in (ROOT / name for name in names):
            if path.is_dir():
                shutil.copytree(path, source / target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(path, source / target)
    run_in(source, sys.executable, "-m", "build", "--no-isolation", ".")
    (built,) = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel and its dependencies, and numba's compiled kernels of this checkout."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    install = [sys.executable, "-m", "pip", "--python", folder / "bin" / "python", "install", "-qq", "--no-compile"]
    # This build of PyTorch may be in pip's sources, or at PyTorch only, as in setup.sh.
    install += ["-c", ROOT / "constraints.txt", f"torch=={importlib.metadata.version('torch')}", wheel]
    (index,) = re.findall(r"^CPU_WHEELS=(\S+)", (ROOT / "setup.sh").read_text("utf-8"), re.MULTILINE)
    try:
        run_in(folder, *install, "--retries", "1")
    except AssertionError:
        run_in(folder, *install, "--extra-index-url", index)
    (site,) = folder.glob("lib/python3.*/site-packages")
    for compiled in (ROOT / "pansplat").rglob("*.nb[ic]"):
        copy = site / compiled.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(compiled, copy)
    return folder


def test_the_wheel_contains_every_module_and_shader_and_nothing_else(wheel: Path) -> None:
    names, version = zipfile.ZipFile(wheel).namelist(), pansplat.__version__
    assert {name.split("/")[0] for name in names} == {"pansplat", "pansplat_viewer", f"pansplat-{version}.dist-info"}
    assert not [name for name in names if "test_" in name or "conftest" in name or "__pycache__" in name]
    needed = {"pansplat/py.typed"}
    for package, folder in FOLDERS.items():
        files = (file for file in (ROOT / folder).rglob("*") if file.suffix in SUFFIXES)
        needed |= {f"{package}/{file.relative_to(ROOT / folder).as_posix()}" for file in files}
    assert not needed - set(names) and any(name.endswith(".frag") for name in needed)


def test_the_modules_of_an_installed_wheel_have_the_hashes_of_the_checkout(environment: Path) -> None:
    modules = ("pansplat.sweep.guided_sweep", "pansplat.refinement", "pansplat.poses.files", "pansplat.model.network")
    program = f"import pansplat.system.source_hash as s; print(s.__file__, *map(s.hash_sources, {modules}))"
    file, *hashes = run_in(environment, environment / "bin" / "python", "-c", program).split()
    assert Path(file).is_relative_to(environment) and hashes == [hash_sources(module) for module in modules]


@pytest.mark.parametrize(
    "command", sorted({"pansplat", "pansplat-view", "pansplat-train", *json.loads(list_instructions("ENTRYPOINT")[0])})
)
def test_installed_commands_have_a_version_and_help(environment: Path, command: str) -> None:
    assert run_in(environment, environment / "bin" / command, "--version") == f"{command} {pansplat.__version__}\n"
    assert f"usage: {command} " in run_in(environment, environment / "bin" / command, "--help")


def test_an_installed_wheel_needs_its_dependencies_only(environment: Path, tmp_path: Path) -> None:
    directions = fibonacci_directions(200).float()
    gaussians = make_balls(2 * directions, 0.1, harmonics=directions[:, None])
    scene = Scene(gaussians, torch.eye(4, dtype=torch.float64)[None], 0.5, 10.0, ("a",), "", 32)
    save_ply(scene, tmp_path / "scene.ply")
    options = ["--offscreen", "out", "--size", "64x32", "--seconds", "0.1"]
    run_in(tmp_path, environment / "bin" / "pansplat-view", "scene.ply", *options)
    with av.open(str(tmp_path / "out" / "film.mp4")) as film:
        assert len(list(film.decode(video=0))) > 1


def test_the_python_of_the_readme_runs_from_an_installed_wheel(
    environment: Path, tmp_path: Path, write_pair: Callable[..., Path], write_tour: Callable[..., Path]
) -> None:
    """On small photographs."""
    write_pair(tmp_path / "my_pair", height=64)
    write_tour(tmp_path / "my_house", 3)
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL | re.MULTILINE)
    program = (
        "import torch\n"
        "images, cam2world = torch.rand(2, 3, 64, 128), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)\n"
        "cam2world[1, 0, 3] = 0.5\n"
        f"{code}\n"
        "house = pansplat.predict('my_house')\n"
        "print(pansplat.__file__, *image.shape, len(house.cam2world), *picture.shape)\n"
    )
    output = run_in(tmp_path, environment / "bin" / "python", "-c", program).split()
    assert Path(output[0]).is_relative_to(environment) and output[1:] == ["3", "64", "128", "3", "3", "512", "1024"]
    assert (tmp_path / "scene.ply").is_file()


def test_the_installed_numba_is_within_an_upper_bound() -> None:
    (numba,) = (each for each in map(Requirement, PROJECT["dependencies"]) if each.name == "numba")
    assert importlib.metadata.version("numba") in numba.specifier and "99" not in numba.specifier


def test_setup_pins_every_direct_dependency() -> None:
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0] for line in constraints if line and not line.startswith("#")}
    requirements = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]
    assert not {re.split("[;>=[]", name)[0].strip().lower().replace("_", "-") for name in requirements} - pinned
