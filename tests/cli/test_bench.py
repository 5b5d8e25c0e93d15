"""`pansplat bench` from end to end, on scenes of a few hundred Gaussians."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from pansplat import pipeline
from pansplat.bench import raster, raster_cases, roofline
from pansplat.bench.raster_cases import Group
from pansplat.bench.scenes import full_lattice_room, lattice_room_size, room_cameras
from pansplat.cli import bench, run
from pansplat.errors import InputError
from pansplat.gaussians.scene import Scene

_raster_groups = raster_cases.raster_groups


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Seconds instead of minutes: a small dense image, few repeats, no sample, no viewer."""
    monkeypatch.setattr(raster_cases, "DENSE_HEIGHT", 8)
    monkeypatch.setattr(raster, "_MAX_REPEATS", 1)
    monkeypatch.setattr(roofline, "_STEPS", 1 << 12)
    monkeypatch.setattr(roofline, "_ELEMENTS", 1 << 12)
    monkeypatch.setattr(bench, "_SAMPLE", Path("no such folder"))
    monkeypatch.setattr(raster, "render_in_viewer", _no_viewer)
    monkeypatch.setattr(bench, "_RASTER_BACKENDS", ("triton", "gsplat"))
    monkeypatch.setattr(raster_cases, "raster_groups", _one_per_suite)


def _one_per_suite(*arguments: Any, **options: Any) -> list[Group]:
    """The first group of each suite, with its first three cases."""
    found = {group.suite: group for group in reversed(_raster_groups(*arguments, **options))}
    return [dataclasses.replace(group, cases=group.cases[:3]) for group in reversed(found.values())]


def _no_viewer(*_: object) -> None:
    raise InputError("there is none in this test")


def test_quick_writes_rows_and_pictures_and_prints_the_tables(tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["bench", "raster", "--quick", "--height", "16", "--out", str(out), "--threads", "1"]) == 0
    content = json.loads((out / "raster.json").read_text())
    assert {row["suite"] for row in content["rows"]} == {"headline", "choices", "dense", "count", "resolution"}
    assert all(row["forward_ms"] > 0 for row in content["rows"])
    assert content["machine"]["threads"] == 1
    assert sorted(file.name for file in out.iterdir()) == [
        *("raster.json", "raster.md", "raster.png", "raster_sweeps.png")
    ]
    printed = capsys.readouterr().out
    for word in ("headline", "choices", "PSNR dB", "without the viewer: there is none in this test", "dense renderer"):
        assert word in printed


def test_a_scene_of_the_users_is_measured(tmp_path):
    scene = Scene(full_lattice_room(16), room_cameras(2), 0.1, 10.0, ("a", "b"))
    pipeline.save(scene, tmp_path / "mine.ply")
    file = tmp_path / "rows.json"
    command = ["bench", "raster", str(tmp_path / "mine.ply"), "--quick", "--height", "16", "--json", str(file)]
    assert run(command) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["scene"] for row in rows} == {"mine", "mine 1/16"}


def test_a_pairs_depth_is_measured_with_a_gaussian_at_every_lattice_point(tmp_path):
    sample, file = Path(__file__).parents[2] / "assets" / "living_room", tmp_path / "rows.json"
    command = ["bench", "raster", str(sample), "--scene-from", "depth", "--quick", "--height", "16"]
    assert run([*command, "--json", str(file)]) == 0
    headline = [row for row in json.loads(file.read_text())["rows"] if row["suite"] == "headline"]
    assert {(row["scene"], row["num_gaussians"]) for row in headline} == {("living_room", lattice_room_size(16))}


def test_an_interruption_prints_and_keeps_what_was_measured(tmp_path, monkeypatch, capsys):
    original = raster.render_case

    def interrupted(case, *arguments):
        if case.layout == "cubemap":
            raise KeyboardInterrupt
        return original(case, *arguments)

    monkeypatch.setattr(raster, "render_case", interrupted)
    file = tmp_path / "rows.json"
    assert run(["bench", "raster", "--quick", "--height", "16", "--json", str(file), "--threads", "1"]) == 130
    assert len(json.loads(file.read_text())["rows"]) >= 2
    printed = capsys.readouterr()
    assert "headline: room 16" in printed.out and "interrupted" in printed.err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--height", "20"], "multiple of 8"),
        (["--height", "7"], "--height must be"),
        (["--threads", "0"], "--threads must be at least 1"),
        (["--json", "no/rows.json"], "create it first"),
        (["--plot", "rows.jpg"], ".png, .svg or .pdf"),
        (["none.ply"], "none.ply"),
        (["none.ply", "--scene-from", "depth"], "needs a pair's folder"),
    ],
)
def test_unusable_arguments_are_refused_before_the_work(arguments, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(["bench", "raster", *arguments]) == 2
    assert told in capsys.readouterr().err


def test_the_machine_is_described(capsys):
    assert run(["bench", "machine", "--threads", "1"]) == 0
    printed = capsys.readouterr().out
    assert "fma_gflops" in printed and "1: " in printed
