"""`pansplat bench` from end to end, on scenes of a few hundred Gaussians."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from pansplat import pipeline
from pansplat.bench import raster, raster_cases
from pansplat.bench.raster_cases import Group
from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.cli import bench, run
from pansplat.gaussians.scene import Scene

SAMPLE = Path(__file__).parents[2] / "assets" / "living_room"
_raster_groups = raster_cases.list_raster_groups


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Seconds instead of minutes: one repeat, few cases, no sample."""
    monkeypatch.setattr(raster, "_MAX_REPEATS", 1)
    monkeypatch.setattr(bench, "_SAMPLE", Path("no such folder"))
    monkeypatch.setattr(bench, "_RASTER_BACKENDS", ("triton",))
    monkeypatch.setattr(raster_cases, "list_raster_groups", _one_per_suite)


def _one_per_suite(*arguments: Any, **options: Any) -> list[Group]:
    """The first group of each suite, with its first three cases."""
    found = {group.suite: group for group in reversed(_raster_groups(*arguments, **options))}
    return [dataclasses.replace(group, cases=group.cases[:3]) for group in reversed(found.values())]


@pytest.mark.slow
def test_the_quick_run_writes_rows_and_plots_and_prints_the_tables(tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["bench", "raster", "--quick", "--height", "16", "--out", str(out), "--threads", "1"]) == 0
    content = json.loads((out / "raster.json").read_text())
    assert {row["suite"] for row in content["rows"]} == {"headline", "choices", "count", "resolution"}
    assert all(row["forward_ms"] > 0 for row in content["rows"])
    assert content["machine"]["threads"] == 1
    assert sorted(file.name for file in out.iterdir()) == [
        *("raster.json", "raster.md", "raster.png", "raster_sweeps.png")
    ]
    printed = capsys.readouterr().out
    for word in ("headline", "choices", "PSNR dB"):
        assert word in printed


@pytest.mark.slow
def test_a_ply_scene_is_measured(tmp_path):
    scene = Scene(full_lattice_room(16), make_room_cameras(2), 0.1, 10.0, ("a", "b"))
    pipeline.save(scene, tmp_path / "mine.ply")
    file = tmp_path / "rows.json"
    command = ["bench", "raster", str(tmp_path / "mine.ply"), "--quick", "--height", "16", "--json", str(file)]
    assert run(command) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["scene"] for row in rows} == {"mine", "mine 1/16"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("raster --height 20", "multiple of 8"),
        ("raster --height 7", "--height must be"),
        ("raster --threads 0", "--threads must be a whole number of 1"),
        ("raster --json no/rows.json", "create it first"),
        ("raster --plot rows.jpg", ".png, .svg or .pdf"),
        ("raster none.ply", "none.ply"),
        ("model --height 80", "multiple of 64"),
        ("model --threads 0", "--threads must be a whole number of 1"),
        ("model --json no/rows.json", "create it first"),
        ("model --pair nowhere", "nowhere is not a folder"),
        ("model --height 64 --model none.safetensors", "none.safetensors"),
        ("memory --heights 80", "multiple of 32"),
        ("memory --heights 32", "64 to 8192 pixels"),
        ("memory --threads 0", "--threads must be a whole number of 1"),
        ("memory --limit-gb 0", "--limit-gb must be a number above 0"),
    ],
)
def test_invalid_arguments_are_refused_before_the_work(arguments, message, refusal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "_RASTER_BACKENDS", ())
    if "--model" in arguments:
        monkeypatch.setattr(bench, "_SAMPLE", SAMPLE)
    assert message in refusal("bench", *arguments.split())
