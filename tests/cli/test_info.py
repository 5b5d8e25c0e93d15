"""The output of `pansplat info` and `pansplat check`."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pansplat.cli import run
from pansplat.evaluation.pose_check import PoseCheck


def test_info_prints_counts_and_cameras(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(scene)]) == 0
    out = capsys.readouterr().out
    assert "1,024 Gaussians, SH degree 0" in out
    assert out.count("256") >= 4  # two levels of two views
    assert "opacity" in out and "median 0.9" in out
    assert "camera 1" in out and "(1, 0, 0) m" in out and "bounds" in out


def test_info_says_what_runs_where(
    monkeypatch: pytest.MonkeyPatch, refusal, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert run(["info", "--device"]) == 0
    assert "can use no graphics card: all work runs on the processor" in capsys.readouterr().out
    assert "needs a scene file or --device" in refusal("info")


@pytest.mark.shared
def test_check_exits_with_1_if_the_convention_is_wrong(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = str(shared / "data" / "mp3d_sample")
    assert run(["check", pair]) == 0
    assert "as given" in capsys.readouterr().out
    assert run(["check", pair, "--convention", "cam2world opencv"]) == 1
    assert "likely mistake" in capsys.readouterr().out


def test_check_is_undecided_between_what_fits_about_as_well(pair_folder: Path, monkeypatch, capsys) -> None:
    errors = {"as given": 0.445, "mirrored up-down": 0.450}
    found = PoseCheck("a", 2.0, 0.445, errors, (), None, True, ())
    monkeypatch.setattr("pansplat.evaluation.pose_check.check_pair", lambda pair: found)
    assert run(["check", str(pair_folder)]) == 0
    printed = "undecided between as given (0.445) and what fits about as well: mirrored up-down (0.450)"
    assert printed in capsys.readouterr().out


@pytest.mark.slow
def test_check_draws_no_conclusion_from_unrelated_panoramas(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generator = np.random.default_rng(0)
    poses = {}
    for i, name in enumerate(("left.png", "right.png")):
        cv2.imwrite(str(tmp_path / name), generator.integers(0, 256, (64, 128, 3), np.uint8))
        poses[name] = [[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (tmp_path / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    assert run(["check", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "the check cannot judge these poses" in out and "no other interpretation" not in out
    assert out.rstrip().endswith("undecided: the check says nothing for or against these poses")
