"""`pansplat evaluate` on folders of pairs and with --protocol: files, output, refused arguments."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat import pipeline
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


def test_each_panorama_of_a_tour_is_left_out(tmp_path: Path, write_tour, write_pair, refusal) -> None:
    tour, out = write_tour(tmp_path / "house", 4), tmp_path / "out"
    start = ["evaluate", str(tour), "--leave-one-out", "--out", str(out), "--model", "sphere", "--height", "64"]
    assert run(start) == 0
    results = json.loads((out / "results.json").read_text())
    assert [result["name"] for result in results] == [f"p{k}" for k in range(4)]
    assert all((out / result["name"] / "target.png").is_file() for result in results)
    two = write_pair(tmp_path / "pair")
    assert "needed a tour of three or more panoramas" in refusal("evaluate", two, "--leave-one-out", "--out", out)


def test_folders_without_targets_are_refused(tmp_path: Path, write_room, capsys) -> None:
    alone = write_room(tmp_path / "alone", target=False)
    assert run(["evaluate", str(alone), "--out", str(tmp_path / "out"), "--model", "sphere"]) == 2
    assert "none of the pairs has a target view" in capsys.readouterr().err


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """One Replica triplet in PanoGRF's layout."""
    scene = tmp_path / "data" / "png_render_test_1024x512_seq_len_3_replica_dist_0.5" / "00000000"
    for view in range(3):
        folder = scene / f"{view:02d}"
        folder.mkdir(parents=True)
        Image.fromarray(np.full((HEIGHT, 2 * HEIGHT, 3), 60 * view + 60, np.uint8)).save(folder / "rgb.png")
        np.savetxt(folder / "rot.txt", np.eye(3))
        np.savetxt(folder / "tran.txt", [0.5 * view, 0, 0])
    return tmp_path / "data"


def arguments(data: Path, out: Path, *more: str) -> list[str]:
    start = ["evaluate", "--protocol", "replica", "--data", str(data), "--out", str(out), "--model", "sphere"]
    return [*start, "--height", str(HEIGHT), *more]


def test_a_protocol_prints_the_papers_rows_and_ours(data: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert run(arguments(data, out)) == 0
    printed = capsys.readouterr().out
    assert "PanoGRF" in printed and "29.22" in printed and "ours, sphere + deferred blending" in printed
    assert "Replica 1.0 m: 1 image" in printed and "No LPIPS" in printed
    (row,) = json.loads((out / "results.json").read_text())["results"]
    assert f"{row['ws_psnr']:.2f}" in printed and row["lpips"] is None
    assert "29.22" in (out / "table.md").read_text()
    assert (out / "replica_1.0_m" / "00000000" / "01_target.png").is_file()


def test_each_model_has_a_row(data: Path, tmp_path: Path, sphere_model: type, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pipeline._MODELS, "other", sphere_model)
    assert run(arguments(data, tmp_path / "out", "--models", "other", "--blend", "joint")) == 0
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["results"]
    assert [row["method"] for row in rows] == ["ours, sphere", "ours, other"]
