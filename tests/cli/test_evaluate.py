"""`pansplat evaluate` on folders of pairs: files, output, refused arguments."""

import json
from pathlib import Path

import pytest

from pansplat.cli import run

HEIGHT = 64


@pytest.fixture(autouse=True)
def no_lpips_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PANSPLAT_LPIPS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


def test_evaluate_writes_results_and_prints_the_table(room: Path, tmp_path: Path, write_room, capsys) -> None:
    write_room(tmp_path / "alone", target=False)
    start = ["evaluate", str(room), str(tmp_path / "alone"), "--out", str(tmp_path / "out"), "--model", "sphere"]
    assert run([*start, "--height", "64"]) == 0
    out, err = capsys.readouterr()
    assert "WS-PSNR" in out and "cross-fade" in out and "room" in out
    assert "alone: no target view in 2 pairs; skipped" in err
    (result,) = json.loads((tmp_path / "out" / "results.json").read_text())
    assert f"{result['ws_psnr']:.2f}" in out
    assert Path(result["prediction"]).is_file() and Path(result["target"]).is_file()


def test_each_panorama_of_a_tour_is_left_out(tmp_path: Path, write_tour, write_pair, refusal, capsys) -> None:
    tour, out = write_tour(tmp_path / "house", 4), tmp_path / "out"
    start = ["evaluate", str(tour), "--leave-one-out", "--out", str(out), "--model", "sphere", "--height", "64"]
    assert run(start) == 0
    results = json.loads((out / "results.json").read_text())
    assert [result["name"] for result in results] == [f"p{k}" for k in range(4)]
    assert all((out / result["name"] / "target.png").is_file() for result in results)
    two = write_pair(tmp_path / "pair")
    assert "needed a tour of three or more panoramas" in refusal("evaluate", two, "--leave-one-out", "--out", out)
    assert run(["evaluate", str(two), "--out", str(out), "--model", "sphere"]) == 2
    assert "none of the pairs has a target view" in capsys.readouterr().err
