"""`pansplat bench raster`: errors against the exact image, and files."""

import json
import math
from dataclasses import replace
from pathlib import Path

import torch

from pansplat.bench import raster
from pansplat.bench.harness import run as run_suite
from pansplat.bench.raster import RASTER, Group, RasterCase, default_face_size, list_choices, make_room_scene
from pansplat.bench.scenes import full_lattice_room, lattice_room_size, make_room_cameras
from pansplat.cli import bench, run
from pansplat.evaluation.results import Row

DIRECT = RasterCase("torch", 16)
FACES = replace(DIRECT, layout="cubemap", face_size=default_face_size(16))


def measure(*cases: RasterCase) -> list[Row]:
    group = Group("choices", make_room_scene(16), [replace(case, backward=False) for case in cases])
    return run_suite(RASTER, raster.measure_raster([group, group], budget=0), {})


def test_errors_are_against_the_exact_image_of_the_layout_which_is_rendered_once():
    pinhole, official = replace(DIRECT, layout="pinhole"), list_choices("torch", 16, 1)[-1]
    cases = (FACES, official, pinhole, replace(pinhole, kernel="ewa"))
    rows = measure(*cases)
    assert [row.get("layout") for row in rows if row.get("precision") == "float64"] == ["equirect", "pinhole"]
    exact, official, pinhole, pinhole_ewa = [row for row in rows if row.get("precision") == "float32"][:4]
    assert exact.get("psnr_db") > official.get("psnr_db")
    assert pinhole.get("max_error") < 1e-5 and pinhole_ewa.get("max_error") > 1e-3


def test_the_room_has_the_papers_counts_and_discs_of_half_a_pixel_to_a_pixel():
    room, again = full_lattice_room(64), full_lattice_room(64)
    assert len(room) == lattice_room_size(64) == 13_848 and torch.equal(room.means, again.means)
    assert [lattice_room_size(height) for height in (256, 512, 2048)] == [221_642, 886_580, 14_185_312]
    distance = (room.means - make_room_cameras(2)[room.views.long(), :3, 3]).norm(dim=1)
    pixels = room.scales[:, 1] / distance / (math.pi / 64 * 2.0**room.levels)
    assert float(pixels.min()) > 0.4999 and float(pixels.max()) < 1.0001


def test_the_quick_run_writes_rows_and_a_plot_and_prints_the_tables(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(raster, "_MAX_REPEATS", 1)
    monkeypatch.setattr(bench, "_SAMPLE", Path("no such folder"))
    out = tmp_path / "out"
    threads = torch.get_num_threads()
    command = ["bench", "raster", "--quick", "--height", "16", "--out", str(out), "--threads", str(threads)]
    assert run(command) == 0
    content = json.loads((out / "raster.json").read_text())
    assert {row["suite"] for row in content["rows"]} == {"headline", "choices"}
    assert {row["scene"] for row in content["rows"]} == {"room 16", "room 8"}
    for row in content["rows"]:
        assert row["forward_min_ms"] <= row["forward_ms"] and row["max_error"] is not None
        assert row["is_reference"] or {"backward_ms", "forward_cpu_ms", "backward_cpu_ms", "peak_mb"} <= row.keys()
    assert content["machine"]["threads"] == threads
    assert sorted(file.name for file in out.iterdir()) == ["raster.json", "raster.md", "raster.png"]
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("headline", "choices", "PSNR dB"))
