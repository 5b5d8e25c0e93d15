"""`pansplat bench` from end to end, on scenes of a few hundred Gaussians."""

import json
from pathlib import Path

import pytest

from pansplat import pipeline
from pansplat.bench import raster
from pansplat.bench.scenes import full_lattice_room, make_room_cameras
from pansplat.cli import bench, run
from pansplat.gaussians.scene import Scene

SAMPLE = Path(__file__).parents[2] / "assets" / "living_room"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Seconds instead of minutes: one repeat, a few cases, no sample."""
    monkeypatch.setattr(raster, "_MAX_REPEATS", 1)
    monkeypatch.setattr(bench, "_SAMPLE", Path("no such folder"))
    monkeypatch.setattr(raster, "list_choices", lambda backend, height, threads: [])


@pytest.mark.parametrize("file", [None, "mine.ply"])
def test_the_quick_run_writes_rows_and_a_plot_and_prints_the_tables(file, tmp_path, capsys):
    out, scene = tmp_path / "out", []
    if file:
        room = Scene(full_lattice_room(16), make_room_cameras(2), 0.1, 10.0, ("a", "b"))
        pipeline.save(room, tmp_path / file)
        scene = [str(tmp_path / file)]
    assert run(["bench", "raster", *scene, "--quick", "--height", "16", "--out", str(out), "--threads", "1"]) == 0
    content = json.loads((out / "raster.json").read_text())
    assert {row["suite"] for row in content["rows"]} == {"headline", "choices"}
    assert {row["scene"] for row in content["rows"]} == ({"mine"} if file else {"room 16", "room 8"})
    assert all("forward_ms" in row and row["max_error"] is not None for row in content["rows"])
    assert content["machine"]["threads"] == 1
    assert sorted(file.name for file in out.iterdir()) == ["raster.json", "raster.md", "raster.png"]
    printed = capsys.readouterr().out
    for word in ("headline", "choices", "PSNR dB", "numba on one thread is"):
        assert word in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("raster --height 20", "multiple of 8"),
        ("raster --height 7", "--height: needed"),
        ("raster --threads 0", "--threads: needed a whole number >= 1"),
        ("raster --json no/rows.json", "create it first"),
        ("raster none.ply", "none.ply"),
        ("model --height 80", "multiple of 64"),
        ("model --threads 0", "--threads: needed a whole number >= 1"),
        ("model --json no/rows.json", "create it first"),
        ("model --pair nowhere", "nowhere is not a folder"),
        ("model --height 64 --model none.safetensors", "none.safetensors"),
    ],
)
def test_invalid_arguments_are_refused_before_the_work(arguments, message, refusal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if "--model" in arguments:
        monkeypatch.setattr(bench, "_SAMPLE", SAMPLE)
    assert message in refusal("bench", *arguments.split())
