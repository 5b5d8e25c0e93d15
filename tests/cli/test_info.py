"""The output of `pansplat info` and `pansplat check`."""

from pathlib import Path

import pytest

from pansplat.cli import run


def test_info_prints_counts_and_cameras(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(scene)]) == 0
    out = capsys.readouterr().out
    assert "1,024 Gaussians, SH degree 0" in out
    assert out.count("256") >= 4  # two levels of two views
    assert "opacity" in out and "median 0.9" in out
    assert "camera 1" in out and "(1, 0, 0) m" in out and "bounds" in out


@pytest.mark.shared
def test_check_exits_with_1_if_the_convention_is_wrong(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = str(shared / "data" / "mp3d_sample")
    assert run(["check", pair]) == 0
    assert "as given" in capsys.readouterr().out
    assert run(["check", pair, "--convention", "cam2world opencv"]) == 1
    assert "likely mistake" in capsys.readouterr().out
