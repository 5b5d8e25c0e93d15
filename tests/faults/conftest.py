"""A tiny pair, scene and weights, and a function that runs a command and checks how it ends."""

from __future__ import annotations

import os
import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from synthetic_scenes import make_balls, place_cameras

from pansplat import pipeline
from pansplat.cli import run
from pansplat.gaussians.scene import Scene
from pansplat.model.pansplat import PanSplat
from pansplat.networks.weights import pack_weights, save_weights
from pansplat.training.__main__ import run as run_training
from pansplat_viewer import run as run_viewer

PROGRAMS: dict[str, Callable[[list[str]], int]] = {"pansplat-train": run_training, "pansplat-view": run_viewer}


STATED = ("note: ", "progress: ", "tiny: ")
"""The starts of lines that are no errors: notes, the progress of a slow machine, and the network of a training."""


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    status: int
    out: str
    err: str

    @property
    def has_error(self) -> bool:
        return not all(line.startswith(STATED) for line in self.err.splitlines())


def make_scene(count: int = 12) -> Scene:
    """Some Gaussians of two views, with two input cameras."""
    random = torch.Generator().manual_seed(0)
    means, colors = torch.randn(count, 3, generator=random) * 2, torch.rand(count, 1, 3, generator=random)
    gaussians = make_balls(means, 0.2, 0.8, harmonics=colors, views=torch.arange(count) * 2 // count)
    poses = place_cameras((0, 0, 0), (0.5, 0, 0))
    return Scene(gaussians, poses, near=0.45, far=10.0, names=("a.png", "b.png"), model="sphere", height=64)


@pytest.fixture(scope="session")
def originals(tmp_path_factory: pytest.TempPathFactory, small_config: Any, write_room: Callable[..., Path]) -> Path:
    """The undamaged files: `pair`, `scene.ply`, `weights.safetensors`."""
    folder = tmp_path_factory.mktemp("originals")
    write_room(folder / "pair", height=16, baseline=0.5)
    pipeline.save(make_scene(), folder / "scene.ply")
    torch.manual_seed(0)
    network = PanSplat(small_config)
    packed = pack_weights("pansplat", small_config, network.state_dict(), compat="fixed")
    save_weights(folder / "weights.safetensors", packed)
    return folder


@pytest.fixture
def folder(tmp_path: Path, originals: Path, monkeypatch: pytest.MonkeyPatch, sphere_predictor: type) -> Path:
    """The current folder of a command, with its own copy of the files and `--model sphere`."""
    work = tmp_path / "work"
    shutil.copytree(originals, work)
    (tmp_path / "temporary").mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.setitem(pipeline.models._MODELS, "sphere", sphere_predictor)
    return work


@pytest.fixture
def attack(folder: Path, capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """A function that runs a command line in `folder`.

    It checks what holds for every fault: no traceback, no internal error, at most one line of an error, no incomplete
    file, and no new file if the command failed.
    """

    def run_command_line(line: list[str]) -> Outcome:
        before = list_files(folder)
        capfd.readouterr()
        program, arguments = (PROGRAMS[line[0]], line[1:]) if line[0] in PROGRAMS else (run, line)
        try:
            with warnings.catch_warnings():
                status = program(arguments)
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 0
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err, err
        assert status != 70, err
        errors = [text for text in err.splitlines() if not text.startswith(STATED)]
        new = list_files(folder) - before
        assert not [name for name in new if re.search(r"/\.[^/]*\.[0-9a-f]{8}\.", f"/{name}")], new
        if status not in (0, 1):
            is_frame = errors[0].startswith("╭") and errors[-1].startswith("╰")  # of the parser of arguments
            assert is_frame or (len(errors) == 1 and errors[0].startswith(("error: ", "interrupted: "))), err
            assert not {name for name in new if not name.startswith("pair/.pansplat")}, new
        return Outcome(status, out, err)

    return run_command_line


def list_files(folder: Path) -> set[str]:
    """The files of a folder, relative to it."""
    return {os.path.relpath(Path(root, name), folder) for root, _, names in os.walk(folder) for name in names}
