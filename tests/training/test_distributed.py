"""Two processes learn what one does from the joint batch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import torch

_PROGRAM = Path(__file__).parent / "two_processes.py"


def test_two_processes_have_the_gradients_of_one_with_the_joint_batch(tmp_path: Path) -> None:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    for command in ([sys.executable], launch):
        done = subprocess.run(
            [*command, str(_PROGRAM), str(tmp_path)], env=environment, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout + done.stderr
    whole, first, second = (torch.load(tmp_path / f"{name}.pt") for name in ("1_0", "2_0", "2_1"))
    assert any("norm" in name and "running" in name for name in whole)
    assert whole.keys() == first.keys() == second.keys()
    for name, wanted in whole.items():
        scale = float(wanted.abs().max())
        torch.testing.assert_close(first[name], wanted, rtol=1e-7, atol=1e-9 * scale + 1e-15, msg=name)
        torch.testing.assert_close(second[name], first[name], rtol=0, atol=0)
