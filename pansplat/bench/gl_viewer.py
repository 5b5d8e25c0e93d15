"""The viewer's OpenGL renderer as a peer. It is run as a command of its own: nothing may import the viewer."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pansplat.bench.cases import Case, Group
from pansplat.bench.measure import median, spread
from pansplat.bench.raster import Bench, judge
from pansplat.bench.rows import Row
from pansplat.errors import InputError
from pansplat.gaussians.ply import save_ply
from pansplat.gaussians.scene import Scene

TIERS = ("gl33", "gl43")
_PROGRAM = "pansplat_viewer"


def measure_viewer(bench: Bench, group: Group, repeats: int) -> None:
    """Add a row for each tier and case of a group, all of layout "cubemap" or "pinhole"; times include the sort.

    Raises:
        InputError: the viewer is not installed, or finds no OpenGL.
    """
    if importlib.util.find_spec(_PROGRAM) is None:
        raise InputError("the viewer is not installed; install the whole of pansplat for its rows")
    cases = group.cases
    # The truths first: what draws them would disturb the viewer's times.
    truths = [bench.truths(group, case) for case in cases]
    gaussians = group.subject.load()
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.ply"
        save_ply(Scene(gaussians, group.subject.pose[None], near=0.1, far=100.0), scene)
        job = {
            "scene": str(scene),
            "pose": group.subject.pose.tolist(),
            "size": cases[0].size[::-1],
            "repeats": repeats,
            "folder": folder,
            "tiers": TIERS,
            "settings": [_settings(case) for case in cases],
        }
        (Path(folder) / "job.json").write_text(json.dumps(job))
        for line in _lines(Path(folder) / "job.json", cases[0].threads):
            case = cases[line["settings"]]
            row = _row(group, case, len(gaussians), line)
            color = torch.from_numpy(np.load(line["image"])[..., :3]).permute(2, 0, 1)
            judge(row, case, color, *truths[line["settings"]])
            bench.add([row])


def _settings(case: Case) -> dict[str, object]:
    """What the viewer calls the case."""
    layout = {"cubemap": "equirect", "pinhole": "pinhole"}[case.layout]
    return {
        "kernel": case.kernel,
        "order": case.order,
        "lowpass": case.filter,
        "layout": layout,
        "face_size": case.face_size,
    }


def _lines(job: Path, threads: int) -> Iterator[dict[str, Any]]:
    """What the viewer's command prints, line by line."""
    environment = os.environ | {"LP_NUM_THREADS": str(threads)}  # of Mesa's software OpenGL
    command = [sys.executable, "-m", f"{_PROGRAM}.timing", str(job)]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=errors) as program,
    ):
        assert program.stdout is not None
        try:
            for line in program.stdout:
                yield json.loads(line)
        finally:
            program.terminate()
        if program.wait() != 0:
            errors.seek(0)
            told = errors.read().strip().splitlines()
            raise InputError(f"the viewer drew nothing: {told[-1] if told else 'it gave no reason'}")


def _row(group: Group, case: Case, num_gaussians: int, line: dict[str, Any]) -> Row:
    frames, sort = line["frame_ms"], line["sort_ms"]
    return Row(
        suite=group.suite,
        scene=group.subject.name,
        backend=line["tier"],
        kernel=case.kernel,
        order=case.order,
        filter=case.filter,
        layout=case.layout,
        height=case.height,
        face_size=case.face_size,
        stitching=case.stitching,
        precision=case.precision,
        num_gaussians=num_gaussians,
        threads=case.threads,
        forward_ms=median(frames),
        forward_min_ms=min(frames),
        forward_spread_ms=spread(frames),
        repeats=len(frames),
        stages_ms={"sort": sort, "draw": max(0.0, median(frames) - sort)},
        note=f"drawn by {line['renderer']}",
    )
