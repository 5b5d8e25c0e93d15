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


def run_in(site: Path, *command: str | Path, **options: object) -> str:
    """The output of a command that succeeds, with the installed wheel ahead of this checkout's editable install."""
    environment = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(
        command, **{"cwd": site.parent, "env": environment, **options}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed wheel, as site-packages, and the wheel beside it.

    It is built from the files that the Dockerfile copies, and from tests, which it must not contain.
    """
    source = tmp_path_factory.mktemp("source")
    for copied in (*list_instructions("COPY"), "tests tests"):
        *names, target = [word for word in shlex.split(copied) if not word.startswith("--")]
        for path in (ROOT / name for name in names):
            if path.is_dir():
                shutil.copytree(path, source / target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(path, source / target)
    run_in(source, sys.executable, "-m", "build", "--no-isolation", ".", cwd=source, env=None)  # of the sdist
    (built,) = (source / "dist").glob("*.whl")
    site = tmp_path_factory.mktemp("installed") / "site"
    wheel = shutil.move(built, site.parent)
    run_in(site, sys.executable, "-m", "pip", "install", "--no-deps", "-qq", "--target", site, wheel, env=None)
    return site


def test_the_wheel_contains_every_module_and_shader_and_nothing_else(installed: Path) -> None:
    (wheel,) = installed.parent.glob("*.whl")
    names, version = zipfile.ZipFile(wheel).namelist(), PROJECT["version"]
    assert version == pansplat.__version__
    assert {name.split("/")[0] for name in names} == {"pansplat", "pansplat_viewer", f"pansplat-{version}.dist-info"}
    assert not [name for name in names if "test_" in name or "conftest" in name or "__pycache__" in name]
    needed = {"pansplat/py.typed"}
    for package, folder in FOLDERS.items():
        files = (file for file in (ROOT / folder).rglob("*") if file.suffix in SUFFIXES)
        needed |= {f"{package}/{file.relative_to(ROOT / folder).as_posix()}" for file in files}
    assert not needed - set(names) and any(name.endswith(".frag") for name in needed)


def test_the_modules_of_an_installed_wheel_have_the_hashes_of_the_checkout(installed: Path) -> None:
    modules = ("pansplat.sweep.guided_sweep", "pansplat.refinement", "pansplat.poses.files", "pansplat.model.network")
    program = f"import pansplat.system.source_hash as s; print(s.__file__, *map(s.hash_sources, {modules}))"
    file, *hashes = run_in(installed, sys.executable, "-c", program).split()
    assert Path(file).is_relative_to(installed) and hashes == [hash_sources(module) for module in modules]


@pytest.mark.parametrize(
    "command", sorted({"pansplat", "pansplat-view", "pansplat-train", *json.loads(list_instructions("ENTRYPOINT")[0])})
)
def test_the_entry_points_of_an_installed_wheel_work(installed: Path, command: str) -> None:
    assert command in run_in(installed, sys.executable, installed / "bin" / command, "--help")


def find_foreign_modules() -> list[str]:
    """The modules here that neither the wheel nor its dependencies need, except those of installation."""
    waiting, needed = list(PROJECT["dependencies"]), {"pip", "setuptools", "pansplat", "pansplat-homes"}
    while waiting:
        requirement = Requirement(waiting.pop())
        name = re.sub("[-_.]+", "-", requirement.name).lower()
        if (requirement.marker is None or requirement.marker.evaluate({"extra": ""})) and name not in needed:
            needed.add(name)
            waiting += importlib.metadata.requires(name) or []
    modules = importlib.metadata.packages_distributions().items()
    return [m for m, owners in modules if not needed & {re.sub("[-_.]+", "-", owner).lower() for owner in owners}]


def test_an_installed_wheel_needs_its_dependencies_only(installed: Path, tmp_path: Path) -> None:
    """As in a clean environment: a scene is drawn to files while all other packages cannot be imported."""
    foreign = find_foreign_modules()
    assert {"pytest", "beartype", "distributed"} <= set(foreign) and not {"torch", "llvmlite", "PIL"} & set(foreign)
    directions = fibonacci_directions(200).float()
    gaussians = make_balls(2 * directions, 0.1, harmonics=directions[:, None])
    scene = Scene(gaussians, torch.eye(4, dtype=torch.float64)[None], 0.5, 10.0, ("a",), "", 32)
    save_ply(scene, tmp_path / "scene.ply")
    program = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(sys.argv.pop(1).split(',')))\n"
        "import pansplat_viewer\n"
        "sys.exit(pansplat_viewer.main())\n"
    )
    options = ["--offscreen", tmp_path / "out", "--size", "64x32", "--seconds", "0.1"]
    run_in(installed, sys.executable, "-c", program, ",".join(foreign), tmp_path / "scene.ply", *options)
    with av.open(str(tmp_path / "out" / "film.mp4")) as film:
        assert len(list(film.decode(video=0))) > 1


def test_the_python_of_the_readme_runs_from_an_installed_wheel(
    installed: Path, tmp_path: Path, write_pair: Callable[..., Path], write_tour: Callable[..., Path]
) -> None:
    """On small photographs, with numba's compiled kernels of this checkout, and without all other packages."""
    for compiled in (ROOT / "pansplat").rglob("*.nb[ic]"):
        copy = installed / compiled.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(compiled, copy)
    write_pair(tmp_path / "my_pair", height=64)
    write_tour(tmp_path / "my_house", 3)
    (code,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL | re.MULTILINE)
    program = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(sys.argv.pop(1).split(',')))\n"
        "import torch\n"
        "images, cam2world = torch.rand(2, 3, 64, 128), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)\n"
        "cam2world[1, 0, 3] = 0.5\n"
        f"{code}\n"
        "print(pansplat.__file__, *image.shape, len(house.cam2world), *picture.shape)\n"
    )
    output = run_in(installed, sys.executable, "-c", program, ",".join(find_foreign_modules()), cwd=tmp_path).split()
    assert Path(output[0]).is_relative_to(installed) and output[1:] == ["3", "64", "128", "3", "3", "512", "1024"]
    assert (tmp_path / "scene.ply").is_file()


def test_the_installed_numba_is_within_an_upper_bound() -> None:
    (numba,) = (each for each in map(Requirement, PROJECT["dependencies"]) if each.name == "numba")
    assert importlib.metadata.version("numba") in numba.specifier and "99" not in numba.specifier


def test_setup_pins_every_direct_dependency() -> None:
    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {line.split("==")[0] for line in constraints if line and not line.startswith("#")}
    requirements = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]
    assert not {re.split("[;>=[]", name)[0].strip().lower().replace("_", "-") for name in requirements} - pinned
