"""Rows of estimated poses against known ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from synthetic_scenes import place_cameras

from pansplat.bench import pose as bench
from pansplat.cli import run
from pansplat.errors import InputError
from pansplat.evaluation.results import Row
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import Panorama
from pansplat.poses.estimate import PoseEstimate, PoseGroup
from pansplat.poses.solvers import rotation_exp
from pansplat.poses.two_view import RelativePose


def _estimate(panoramas: list[Panorama], turn: float) -> PoseEstimate:
    """The known poses, of twice the size, in another world; one camera is turned."""
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation_exp(np.array((0.3, 1.0, -0.4))), (5, 6, 7)
    found = {}
    for panorama in panoramas:
        pose = panorama.cam2world.numpy().copy()
        pose[:3, 3] *= 2
        found[panorama.image] = world @ pose
    found[panoramas[0].image][:3, :3] @= rotation_exp(np.array((0, turn, 0)))
    figures = {"score": 100.0, "places": 40.0, "uncertainty": (0.01, 0.01), "log_odds": 9.0}
    relation = RelativePose(np.eye(3), np.eye(3)[0], np.empty((0, 2), int), **figures)
    group = PoseGroup(found, 0.5, 10.0, 0.05, "cameras 1.5 m over the floor")
    return PoseEstimate(tuple(found), (group,), {}, {tuple(found)[:2]: relation})


@pytest.mark.parametrize(("turn", "outcome"), [(0.0, "solved"), (0.1, "wrong")])
def test_errors_do_not_depend_on_the_world(monkeypatch: pytest.MonkeyPatch, turn: float, outcome: str) -> None:
    poses = place_cameras((0, 0, 0), (1, 0, 0), (0, 0, 2))
    panoramas = [Panorama(str(n), Path(f"{n}.jpg"), pose) for n, pose in enumerate(poses)]
    monkeypatch.setattr(bench, "estimate_poses", lambda images, camera_height: _estimate(panoramas, turn))
    row = bench.measure_poses("room", panoramas, 1.5, "tour")
    assert row.get("outcome") == outcome
    assert row.get("scale_percent") == pytest.approx(100)
    assert row.get("position_cm") == pytest.approx(0, abs=1e-6)
    assert row.get("rotation_degrees") == pytest.approx(np.degrees(turn), abs=1e-6)
    summary, tours = bench.summarise([Row({**row.case, "suite": "pair"}, row.values), row])
    assert f"1 {outcome}" in summary and ("rotation median 0.000" in summary) == (outcome == "solved")
    assert tours.startswith("1 tours: 3 of 3 panoramas (100%)") and f"{int(turn > 0)} tours with a wrong pose" in tours


@pytest.mark.filterwarnings("ignore:.*has no pose of attic.png")
def test_the_command_writes_a_row_for_each_pair_and_tour(monkeypatch, tmp_path: Path, write_pair) -> None:
    def refuse(images, camera_height):
        raise InputError("no poses were found: too dark.")

    monkeypatch.setattr(bench, "estimate_poses", refuse)
    room, out = write_pair(tmp_path / "room"), tmp_path / "out"
    Image.new("RGB", (32, 16)).save(room / "attic.png")  # a single view is not measured
    assert run(["bench", "pose", str(room), "--tours", "also", "--out", str(out), "--threads", "1"]) == 0
    pair, tour = json.loads((out / "pose.json").read_text())["rows"]
    assert (pair["suite"], tour["suite"], tour["scene"]) == ("pair", "tour", "room")
    assert pair["outcome"] == "flagged" and "too dark" in pair["note"] and pair["count"] == 2
    assert "0 solved, 1 flagged, 0 wrong" in (out / "pose.md").read_text()
    known = {view.image: view for view in load_sets(room)[0].context}
    turned = _estimate(list(known.values()), 0.1)
    monkeypatch.setattr(bench, "estimate_poses", lambda images, camera_height: turned)
    assert run(["bench", "pose", str(room), "--threads", "1"]) == 1  # a wrong pose passed the check
