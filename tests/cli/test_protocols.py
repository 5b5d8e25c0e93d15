"""`pansplat evaluate --protocol` from end to end: what it writes, what it says, what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pansplat import pipeline
from pansplat.cli import run
from pansplat.gaussians.scene import Gaussians

HEIGHT = 32


class Ball:
    """A grey Gaussian round each camera."""

    name, fingerprint = "ball", "1"

    def __call__(self, images, cam2world, near, far, *, masks=None, progress=None):
        count = len(images)
        return Gaussians(
            means=(cam2world[:, :3, 3] + torch.tensor([0.0, 0.0, 2.0])).float(),
            scales=torch.full((count, 3), 0.5),
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            opacities=torch.full((count,), 0.9),
            harmonics=torch.zeros(count, 1, 3),
            levels=torch.zeros(count, dtype=torch.int64),
            views=torch.arange(count),
        )


@pytest.fixture(autouse=True)
def bare_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Our own predictor, and no weights of LPIPS."""
    monkeypatch.setitem(pipeline._MODELS, "ball", Ball)
    monkeypatch.delenv("PANSPLAT_LPIPS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


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
    start = ["evaluate", "--protocol", "replica", "--data", str(data), "--out", str(out), "--model", "ball"]
    return [*start, "--height", str(HEIGHT), *more]


def test_a_protocol_prints_the_papers_table_with_ours_and_writes_its_files(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(arguments(data, out)) == 0
    printed = capsys.readouterr().out
    assert "PanoGRF" in printed and "29.22" in printed and "ours, ball + deferred blending" in printed
    assert "Replica 1.0 m: 1 image" in printed and "No LPIPS" in printed
    (row,) = json.loads((out / "results.json").read_text())["results"]
    assert f"{row['ws_psnr']:.2f}" in printed and row["lpips"] is None
    assert "29.22" in (out / "table.md").read_text()
    assert (out / "replica_1.0_m" / "00000000" / "01_target.png").is_file()


def test_several_models_give_a_row_each(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pipeline._MODELS, "other", Ball)
    assert run(arguments(data, tmp_path / "out", "--models", "other", "--blend", "joint")) == 0
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["results"]
    assert [row["method"] for row in rows] == ["ours, ball", "ours, other"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--near", "1"], "--near is set by the protocol"),
        (["--blend", "view0"], "--blend must be joint or deferred with --protocol"),
        (["--limit", "0"], "--limit must be at least 1"),
        (["--models", "ball"], "must have distinct names"),
        (["--lpips", "vgg"], "LPIPS with vgg needed vgg16-397923af.pth"),
        (["--protocol", "360loc"], "360Loc: needed"),
    ],
)
def test_what_has_no_meaning_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    assert run(arguments(data, tmp_path / "out", *more)) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_protocol_needs_data_and_takes_no_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = ["evaluate", "--out", str(tmp_path / "out"), "--protocol", "m3d"]
    assert run(start) == 2
    assert "--protocol needs --data" in capsys.readouterr().err
    assert run(["evaluate", str(tmp_path), *start[1:], "--data", str(tmp_path)]) == 2
    assert "as well; leave it out" in capsys.readouterr().err
