"""A predictor, panoramas and a scene for the commands' tests."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from pansplat import pipeline
from pansplat.cli import run
from pansplat.gaussians.scene import Gaussians
from pansplat.system.progress import report_progress


@pytest.fixture(autouse=True)
def sphere_model(monkeypatch: pytest.MonkeyPatch, sphere_predictor: type) -> type:
    """The predictor that commands find as `--model sphere`: one Gaussian per pixel of the image at 16 rows."""

    class Sphere(sphere_predictor):
        def __call__(self, images: Tensor, *arguments, **options) -> Gaussians:
            report_progress("predicting", 0.5)
            step = images.shape[-2] // 16
            sphere = super().__call__(images[..., ::step, ::step], *arguments, **options)
            levels = torch.arange(len(sphere)) % 2
            return replace(sphere, scales=torch.full_like(sphere.scales, 0.3), levels=levels)

    monkeypatch.setitem(pipeline.models._MODELS, "sphere", Sphere)
    monkeypatch.setattr("pansplat.export.page._POSTER_SIZE", (27, 32))
    return Sphere


@pytest.fixture
def room(tmp_path: Path, write_room: Callable[..., Path]) -> Path:
    return write_room(tmp_path / "room")


@pytest.fixture
def predict(room: Path, tmp_path: Path) -> Callable[..., int]:
    """A function that runs `pansplat predict` on the room and returns its status."""

    def run_predict(*arguments: str) -> int:
        options = ["--model", "sphere", "--layers", "--refine", "0", "--height", "64"]
        return run(["predict", str(room), "-o", str(tmp_path / "scene.ply"), *options, *arguments])

    return run_predict


@pytest.fixture
def scene(predict: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert predict() == 0
    capsys.readouterr()
    return tmp_path / "scene.ply"


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """A function that runs a command, which must fail with status 2, and returns its one message."""

    def run_refused(*arguments: object) -> str:
        capsys.readouterr()
        assert run([str(argument) for argument in arguments]) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.startswith("error: ") and err.count("\n") == 1
        assert "Traceback" not in err
        return err

    return run_refused
