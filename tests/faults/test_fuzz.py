"""No reader crashes or raises another error than InputError for damaged files."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from panorama_formats import EXAMPLES

from pansplat.cache import CachedScene
from pansplat.gaussians.ply import load_ply
from pansplat.gaussians.scene import Gaussians
from pansplat.system.store import _pack


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_every_reader_survives_damaged_files(originals: Path, tmp_path: Path, small_config: Any, count: int) -> None:
    work = tmp_path / "fuzz"
    shutil.copytree(originals, work)
    types = {each.__name__: each for each in (CachedScene, Gaussians)}
    (work / "cache_body").write_bytes(_pack(CachedScene(load_ply(work / "scene.ply").gaussians), types))
    (work / "config.json").write_text(json.dumps(dataclasses.asdict(small_config)))
    program = Path(__file__).with_name("fuzz.py")
    command = [sys.executable, str(program), str(work), str(count)]
    environment = os.environ | {"PYTHONPATH": str(program.parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    lines = re.findall(r"^(.+): (\d+) inputs, (\d+) accepted", done.stdout, re.MULTILINE)
    assert {
        "scene.ply",
        "poses.json",
        *(f"room {name}" for name, e in EXAMPLES.items() if e.format != "photographs"),
    } <= {name for name, _, _ in lines}
    for name, inputs, accepted in lines:
        assert int(inputs) == count > int(accepted), name  # a reader that accepts all damage reads nothing
    assert f"JSON: {count // 10} inputs" in done.stdout
