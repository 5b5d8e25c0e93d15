"""setup.sh on machines where system packages cannot be installed: its commands are replaced by programs that say so."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = {
    "id": "echo 1000",
    "sudo": '[ "$CAN_SUDO" ] && [ "$2" = true ]',  # but not apt-get
    "dpkg-query": 'case " ${INSTALLED-libegl1} " in *" $4 "*) echo install ok installed ;; esac',
    "nvidia-smi": "exit 9",
    # An environment that it makes has the same program.
    "python": """echo "$*" >>"$LOG"
        case "$*" in
            *importlib.metadata*) [ "$HAS_CPU_BUILD" ] ;;
            *ensurepip*) [ "$HAS_ENSUREPIP" ] ;;
            *-venv*) echo python3.11-venv ;;
            "-m venv "*) [ ! "$NO_VENV" ] && mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
        esac""",
}

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="setup.sh is for Linux")


def run_setup(folder: Path, *options: str, **answers: str) -> subprocess.CompletedProcess[str]:
    """Run a copy of the script; `log` has the calls of Python."""
    for name in ("setup.sh", "constraints.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, folder)
    for name, text in COMMANDS.items():
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "PYTHON": "python", "LOG": str(folder / "log"), **answers}
    return subprocess.run(["bash", folder / "setup.sh", *options], env=environment, capture_output=True, text=True)


@pytest.mark.parametrize(("can_sudo", "has_ensurepip"), [("", "yes"), ("yes", "")])  # with sudo, but without apt-get
def test_without_permission_the_packages_are_listed_and_the_rest_is_installed(
    tmp_path: Path, can_sudo: str, has_ensurepip: str
) -> None:
    done = run_setup(tmp_path, CAN_SUDO=can_sudo, HAS_ENSUREPIP=has_ensurepip)
    assert done.returncode == 0, done.stdout + done.stderr
    (listed,) = [line for line in done.stdout.splitlines() if "sudo apt-get install" in line]
    assert "libgl1 libgl1-mesa-dri libgles2 libx11-6" in listed and "libegl1" not in listed
    assert "everything but the window and OpenGL works" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("setup: ready:")
    calls = (tmp_path / "log").read_text()
    assert "-c constraints.txt -e ." in calls
    assert ("-m pip --python .venv/bin/python install -q pip" in calls) == (not has_ensurepip)


def test_without_a_way_to_make_an_environment_the_package_is_named(tmp_path: Path) -> None:
    done = run_setup(tmp_path, CAN_SUDO="", HAS_ENSUREPIP="", NO_VENV="yes")
    assert done.returncode == 1 and "run: sudo apt-get install python3.11-venv" in done.stderr


def test_no_package_is_missing_where_those_of_the_dockerfile_are_installed(tmp_path: Path) -> None:
    text = (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ")
    (packages,) = re.findall(r"apt-get install -y --no-install-recommends ([^&]+)&&", text)
    done = run_setup(tmp_path, CAN_SUDO="", HAS_ENSUREPIP="yes", INSTALLED=" ".join(packages.split()))
    assert done.returncode == 0 and "setup: ready:" in done.stdout
    assert "apt-get" not in done.stdout, done.stdout


@pytest.mark.parametrize(("has_cpu_build", "option"), [("yes", "--force-reinstall "), ("", "")])
def test_the_cuda_build_of_pytorch_replaces_the_cpu_build(tmp_path: Path, has_cpu_build: str, option: str) -> None:
    """pip takes the one for the other: their public versions are equal."""
    assert run_setup(tmp_path, "--cuda", HAS_ENSUREPIP="yes", CAN_SUDO="", HAS_CPU_BUILD=has_cpu_build).returncode == 0
    (call,) = [
        line for line in (tmp_path / "log").read_text().splitlines() if re.search(r"^-m pip install.* torch==", line)
    ]
    assert f"constraints.txt {option}torch==" in call


def test_setup_has_help_and_refuses_unknown_options() -> None:
    done, refused = (
        subprocess.run(["bash", ROOT / "setup.sh", option], capture_output=True, text=True)
        for option in ("--help", "--dve")
    )
    assert done.returncode == 0 and "--dev" in done.stdout
    assert refused.returncode == 1 and "unknown option --dve" in refused.stderr
