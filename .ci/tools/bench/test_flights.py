"""`pansplat bench flights`: jumps of depth, rows and files."""

import json
from pathlib import Path

import numpy as np
import pytest

from pansplat import pipeline
from pansplat.bench import flights as bench
from pansplat.bench.flights import MEAN, measure_jumps
from pansplat.cli import run

HEIGHT = 64


def test_a_smooth_surface_has_no_jumps_and_an_edge_has_two_pixels() -> None:
    depth = np.full((256, 512), 2.0, np.float32)
    depth *= np.exp(np.linspace(0, 1, 256))[:, None].astype(np.float32)
    assert measure_jumps(depth) == 0
    depth[:, 100:200] *= 1.2
    assert measure_jumps(depth) == pytest.approx(4 / 512), "both sides of both edges"
    flakes = np.where(np.random.default_rng(0).random((256, 512)) < 0.02, 1.3, 1.0)
    assert measure_jumps((depth * flakes).astype(np.float32)) > 0.08
    assert measure_jumps(depth) == measure_jumps(depth.repeat(2, axis=0).repeat(2, axis=1))


def test_the_bench_compares_each_way_to_draw_with_the_targets(
    tmp_path: Path, write_pair, sphere_predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = write_pair(tmp_path / "room", seed=1)
    poses = json.loads((room / "poses.json").read_text())
    poses["poses"]["middle.png"] = poses["poses"]["left.png"]
    (room / "middle.png").write_bytes((room / "left.png").read_bytes())
    (room / "poses.json").write_text(json.dumps(poses))
    pairs = {"pairs": [{"name": "room", "context": ["left.png", "right.png"], "target": "middle.png"}]}
    (room / "pairs.json").write_text(json.dumps(pairs))
    monkeypatch.setitem(pipeline._MODELS, "default", sphere_predictor)
    monkeypatch.setattr(bench, "warm_up", lambda predictor: None)
    out = tmp_path / "out"
    options = ["--height", str(HEIGHT), "--lpips", "none", "--threads", "1", "--out", str(out)]
    assert run(["bench", "flights", str(room), *options]) == 0
    rows = json.loads((out / "flights.json").read_text())["rows"]
    assert [row["scene"] for row in rows] == ["room"] * 4 + [MEAN] * 4
    values = {row["drawing"]: row["ws_psnr_db"] for row in rows[:4]}
    assert list(values) == ["deferred", "joint", "view 0", "view 1"]
    assert values["view 0"] > 15 > values["view 1"], "the target is at the first view"
    assert rows[4]["ws_psnr_db"] == values["deferred"]
    assert (out / "flights.png").stat().st_size > 1000 and "| deferred |" in (out / "flights.md").read_text()
