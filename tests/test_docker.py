"""The Dockerfile installs what setup.sh and the packages need. CI has no Docker: the image is not built here."""

import json
import re
import shlex
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
INSTRUCTIONS = [
    line.split(maxsplit=1)
    for line in (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ").splitlines()
    if line and not line.startswith("#")
]


def list_values(name: str) -> list[str]:
    return [value for instruction, value in INSTRUCTIONS if instruction == name]


def list_copied() -> list[str]:
    """The files and folders that are copied into the image."""
    words = [shlex.split(value) for value in list_values("COPY")]
    return [word for line in words for word in line[:-1] if not word.startswith("--")]


def test_the_packages_are_those_of_setup() -> None:
    (listed,) = re.findall(r"apt-get install -y --no-install-recommends ([^&]+)&&", list_values("RUN")[0])
    (needed,) = re.findall(r"^GL_PACKAGES=\((.+)\)$", (ROOT / "setup.sh").read_text("utf-8"), re.MULTILINE)
    assert listed.split() == ["python3", "python3-venv", *needed.split()]


def test_all_that_the_packages_need_is_copied() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    folders = settings["tool"]["setuptools"]["package-dir"].values()
    files = ["pyproject.toml", "constraints.txt", "setup.sh", settings["project"]["readme"]]
    copied = list_copied()
    assert sorted(copied) == sorted([*files, *settings["project"]["license-files"], *folders])
    ignored = (ROOT / ".dockerignore").read_text("utf-8").split()
    for name in copied:
        assert (ROOT / name).exists() and name.split("/")[0] not in ignored


def test_the_commands_run_as_a_user_and_are_those_of_the_package() -> None:
    assert INSTRUCTIONS[0][0] == "FROM"
    assert list_values("USER") == ["pansplat"]
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    (entry,) = json.loads(list_values("ENTRYPOINT")[0])
    assert entry in settings["project"]["scripts"]
    assert "bash setup.sh --cpu" in list_values("RUN")[1]
    readme = (ROOT / "README.md").read_text("utf-8")
    assert "docker build -t pansplat ." in readme and "--entrypoint pansplat-view pansplat assets/living_room" in readme
