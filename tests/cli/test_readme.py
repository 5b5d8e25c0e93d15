"""Commands, calls, links and pose files of the README work."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import pansplat
from pansplat.cli import parse

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
BLOCKS = "\n".join(re.findall(r"^```\w*\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE))
COMMANDS = re.findall(r"^(?:\.venv/bin/)?pansplat (.+?)(?:\s+#.*)?$", BLOCKS, flags=re.MULTILINE)


def test_the_readme_shows_every_command() -> None:
    shown = {command.split()[0] for command in COMMANDS}
    assert shown == set(
        ["predict", "refine", "render", "export", "batch", "evaluate", "check", "info", "convert", "bench", "pose"]
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_of_the_readme_are_valid(command: str) -> None:
    parsed = parse(shlex.split(command))
    assert type(parsed).__name__.lower() == command.split()[0]


def test_calls_of_the_readme_exist() -> None:
    calls = set(re.findall(r"pansplat\.(\w+)\(", README))
    assert calls >= {"predict", "render", "load_model", "rasterize", "save", "load"}
    assert calls <= set(pansplat.__all__)


def test_links_and_images_of_the_readme_exist() -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r'src="([^"]+)"', README)
    local = [target for target in targets if not target.startswith("http")]
    assert local
    assert not [target for target in local if not (ROOT / target).exists()]


def test_the_readme_links_every_document() -> None:
    documents = {f"docs/{file.name}" for file in (ROOT / "docs").glob("*.md")}
    assert documents and not [document for document in documents if f"]({document})" not in README]


def test_pose_files_of_the_readme_are_read(tmp_path: Path) -> None:
    (poses,) = re.findall(r"```json\n(.+?)```", README, flags=re.DOTALL)
    (tmp_path / "poses.json").write_text(poses)
    for name in ("left.jpg", "right.jpg"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 16, 3), np.uint8))
    (pair,) = pansplat.load_pairs(tmp_path)
    assert [panorama.image.name for panorama in pair.context] == ["left.jpg", "right.jpg"]
    assert (pair.near, pair.far) == (0.45, 10.0)


def test_the_two_commands_are_those_of_ci_and_setup() -> None:
    assert "bash setup.sh && .venv/bin/pansplat-view assets/living_room" in README
    assert "bash setup.sh --dev && .venv/bin/pytest" in README
    ci = (ROOT / ".ci" / "run").read_text()
    assert "bash setup.sh --dev" in ci and ".venv/bin/pytest" in ci
    assert "assets/living_room" in (ROOT / "setup.sh").read_text()


def test_setup_has_help_and_refuses_unknown_options() -> None:
    if sys.platform == "win32":
        pytest.skip("setup.sh is for Linux")
    done = subprocess.run(["bash", ROOT / "setup.sh", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "--dev" in done.stdout
    refused = subprocess.run(["bash", ROOT / "setup.sh", "--dve"], capture_output=True, text=True)
    assert refused.returncode == 1 and "unknown option --dve" in refused.stderr
