"""The output of `pansplat info` and `pansplat check`."""

from pathlib import Path

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


def test_info_says_what_runs_where(monkeypatch, refusal, capsys) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert run(["info", "--device"]) == 0
    assert "can use no graphics card: all work runs on the processor" in capsys.readouterr().out
    assert "needs a scene file or --device" in refusal("info")


@pytest.mark.shared
def test_check_exits_with_1_if_the_convention_is_wrong(shared: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("pansplat.evaluation.pose_check._HEIGHT", 40)
    pair = str(shared / "data" / "mp3d_sample")
    assert run(["check", pair]) == 0
    assert "as given" in capsys.readouterr().out
    assert run(["check", pair, "--convention", "cam2world opencv"]) == 1
    assert "likely mistake" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("can_judge", "printed"), [(True, "mirrored up-down (0.450)"), (False, "nothing for or against")]
)
def test_check_is_undecided_between_what_fits_about_as_well_and_about_what_it_cannot_judge(
    can_judge: bool, printed: str, pair_folder: Path, monkeypatch, capsys
) -> None:
    errors = {"as given": 0.445, "mirrored up-down": 0.450}
    found = PoseCheck("a", 2.0, 0.445, errors, (), None, can_judge, ("too little in common",))
    monkeypatch.setattr("pansplat.evaluation.pose_check.check_pair", lambda pair: found)
    assert run(["check", str(pair_folder)]) == 0
    out = capsys.readouterr().out
    assert "too little in common" in out and "undecided" in out.splitlines()[-1] and printed in out
