"""`pansplat bench refine`: rows, means, files and plots."""

import json
from pathlib import Path

import pytest
from PIL import Image

from pansplat import pipeline
from pansplat.bench import refine as bench
from pansplat.bench.refine import CROSS_FADE, MEAN, RefineCase
from pansplat.cli import run

HEIGHT = 16


@pytest.fixture
def folder(tmp_path: Path, write_pair, sphere_predictor, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two pairs with a target each; the case list is small and uses a predictor without depth."""
    for name in ("one", "two"):
        room = write_pair(tmp_path / "rooms" / name, seed=len(name))
        poses = json.loads((room / "poses.json").read_text())
        middle = json.loads(json.dumps(poses["poses"]["left.png"]))
        middle["cam2world"][0][3] = 0.25
        poses["poses"]["middle.png"] = middle
        for image in ("left.png", "right.png"):  # smooth, so that the refinement finds an improvement
            smooth = Image.open(room / image).resize((8, 4)).resize((2 * HEIGHT, HEIGHT), Image.Resampling.BICUBIC)
            smooth.save(room / image)
        (room / "middle.png").write_bytes((room / "left.png").read_bytes())
        (room / "poses.json").write_text(json.dumps(poses))
        pairs = {"pairs": [{"name": name, "context": ["left.png", "right.png"], "target": "middle.png"}]}
        (room / "pairs.json").write_text(json.dumps(pairs))

    class DarkSphere(sphere_predictor):
        """A predictor of wrong colours, which the refinement corrects."""

        def __call__(self, images, *arguments, **options):
            return super().__call__(0.7 * images, *arguments, **options)

    monkeypatch.setitem(pipeline.models._MODELS, "default", DarkSphere)
    monkeypatch.setattr(bench, "warm_up", lambda predictor: None)
    monkeypatch.setattr(bench, "time_workload", lambda: 0.02)
    cases = [RefineCase(CROSS_FADE, HEIGHT), RefineCase("default", HEIGHT), RefineCase("default", HEIGHT, 30)]
    cases += [RefineCase("default", HEIGHT, 30, 40), RefineCase("default", HEIGHT, views=1)]
    monkeypatch.setattr(bench, "list_refine_cases", lambda quick: cases)
    return tmp_path / "rooms"


@pytest.mark.usefixtures("any_state")
def test_the_bench_writes_rows_means_table_and_plot(folder: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    paths = [str(folder / name) for name in ("one", "two")]
    assert run(["bench", "refine", *paths, "--out", str(out), "--lpips", "none", "--threads", "1"]) == 0
    rows = json.loads((out / "refine.json").read_text())["rows"]
    assert [row["scene"] for row in rows] == ["one"] * 5 + ["two"] * 5 + [MEAN] * 5
    plain, refined, small, single = rows[1:5]
    assert refined["ws_psnr_db"] > plain["ws_psnr_db"] and refined["steps"] > 1 > plain["refine_s"] == 0
    assert refined["predict_ratio"] == plain["predict_ratio"], "predicted once"
    assert "step_ratio" in refined and "step_ratio" not in plain
    assert small["num_gaussians"] <= 40 < refined["num_gaussians"] < plain["num_gaussians"]
    assert single["num_gaussians"] == plain["num_gaussians"] // 2 and single["ws_psnr_db"] != plain["ws_psnr_db"]
    assert rows[11]["ws_psnr_db"] == pytest.approx((rows[1]["ws_psnr_db"] + rows[6]["ws_psnr_db"]) / 2, rel=1e-4)
    assert "| default | 16 | all | 30 steps | 40 |" in (out / "refine.md").read_text()
    assert (out / "refine.png").stat().st_size > 1000 and "cross-fade" in capsys.readouterr().out


def test_pairs_without_targets_are_refused(tmp_path: Path, write_pair, capsys) -> None:
    write_pair(tmp_path / "alone")
    assert run(["bench", "refine", str(tmp_path / "alone")]) == 2
    assert "none of the 1 pairs has a target view" in capsys.readouterr().err
