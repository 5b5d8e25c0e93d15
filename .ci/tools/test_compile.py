"""The kernels compile for real GPUs, without register spills and atomic instructions."""

import json
import os
import subprocess
import sys
from pathlib import Path


def test_kernels_compile_for_gpus_without_spills_or_atomics(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    script = Path(__file__).with_name("compile_for_gpu.py")
    done = subprocess.run([sys.executable, script, "80"], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(reports) == 11
    for report in reports:
        assert report["STACK"] == report["LOCAL"] == report["atomics"] == 0, report
