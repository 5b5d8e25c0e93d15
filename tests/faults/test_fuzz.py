"""No reader crashes or raises another error than InputError for damaged files."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch

from pansplat.gaussians.ply import load_ply
from pansplat.inputs.reconstructions import _READERS


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_every_reader_survives_damaged_files(originals: Path, tmp_path: Path, small_config: Any, count: int) -> None:
    work = tmp_path / "fuzz"
    shutil.copytree(originals, work)
    gaussians = load_ply(work / "scene.ply").gaussians
    body = safetensors.torch.save({f.name: getattr(gaussians, f.name) for f in dataclasses.fields(gaussians)})
    (work / "cache_body").write_bytes(body + zlib.crc32(body).to_bytes(4, "little"))
    (work / "config.json").write_text(json.dumps(dataclasses.asdict(small_config)))
    program = Path(__file__).with_name("fuzz.py")
    done = subprocess.run([sys.executable, str(program), str(work), str(count)], capture_output=True, text=True)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    lines = re.findall(r"^(.+): (\d+) inputs, (\d+) accepted", done.stdout, re.MULTILINE)
    assert {"scene.ply", "poses.json", *_READERS} <= {name for name, _, _ in lines}
    for name, inputs, accepted in lines:
        assert int(inputs) == count > int(accepted), name  # a reader that accepts all damage reads nothing
    assert f"JSON: {count // 10} inputs" in done.stdout
