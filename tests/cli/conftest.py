"""A predictor, panoramas and a scene for the commands' tests."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from synthetic_scenes import make_balls
from torch import Tensor

from pansplat import pipeline
from pansplat.cli import run
from pansplat.geometry.equirect import pixel_directions
from pansplat.system.progress import report_progress

HEIGHT = 64


class Sphere:
    """A predictor of Gaussians on a sphere of 2 m around each camera, one per pixel of the image at 16 rows."""

    name, fingerprint = "sphere", "1"

    def __call__(self, images: Tensor, cam2world: Tensor, near: float, far: float, *, masks=None):
        report_progress("predicting", 0.5)
        images = images[..., :: images.shape[-2] // 16, :: images.shape[-2] // 16]
        view, _, height, width = images.shape
        directions = pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)
        means = torch.cat([2 * directions @ p[:3, :3].T + p[:3, 3] for p in cam2world.double()])
        color, views = images.flatten(2).transpose(1, 2).reshape(-1, 3), torch.arange(view)
        levels = torch.arange(len(means)) % 2
        return make_balls(means, 0.3, color=color, levels=levels, views=views.repeat_interleave(len(directions)))


@pytest.fixture(autouse=True)
def sphere_model(monkeypatch: pytest.MonkeyPatch) -> type:
    """The predictor, which commands find as `--model sphere`."""
    monkeypatch.setitem(pipeline._MODELS, "sphere", Sphere)
    return Sphere


@pytest.fixture
def room(tmp_path: Path, write_room: Callable[..., Path]) -> Path:
    return write_room(tmp_path / "room")


@pytest.fixture
def predict(room: Path, tmp_path: Path) -> Callable[..., int]:
    """A function that runs `pansplat predict` on the room and returns its status."""

    def run_predict(*arguments: str) -> int:
        start = ["predict", str(room), "-o", str(tmp_path / "scene.ply"), "--model", "sphere", "--layers"]
        return run([*start, "--height", str(HEIGHT), *arguments])

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
