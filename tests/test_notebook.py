"""In a notebook, scenes are shown in the viewer of web pages, panoramas as pictures, and long calls with a bar."""

import base64
import dataclasses
import html
import io
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from IPython.core.formatters import DisplayFormatter
from PIL import Image
from refusals import expect_error
from synthetic_scenes import make_balls, place_cameras
from torch import Tensor

import pansplat
from pansplat import notebook
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians, Scene, empty_gaussians
from pansplat.geometry.fibonacci import fibonacci_directions
from pansplat.inputs.views import Views
from pansplat.rendering import Rendering
from pansplat.system import console
from pansplat.system.progress import report_progress


@pytest.fixture(scope="module")
def scene() -> Scene:
    """400 Gaussians on a sphere of 2 m around two cameras."""
    directions = fibonacci_directions(400).float()
    gaussians = make_balls(2 * directions, 0.1, harmonics=directions[:, None], views=torch.arange(400) % 2)
    poses = place_cameras((0, 0, 0), (0.5, 0, 0))
    return Scene(gaussians, poses, 0.5, 10.0, ("left", "right"), height=64)


def display(value: object) -> dict:
    formatter = DisplayFormatter()
    notebook.register_displays(formatter)
    formatter.active_types = formatter.format_types
    return formatter.format(value)[0]


def open_picture(bundle: dict) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(bundle["image/jpeg"]))))


def test_a_scene_is_the_page_in_a_frame_with_a_picture_and_the_size(scene: Scene) -> None:
    bundle = display(scene)
    page = html.unescape(re.findall(r'srcdoc="([^"]+)"', bundle["text/html"])[0])
    assert page.startswith("<!doctype html>")
    assert 'sandbox="allow-scripts' in bundle["text/html"] and "allow-same-origin" not in bundle["text/html"]
    assert f"400 of 400 Gaussians, {len(page) / 1e6:.1f} MB" in bundle["text/html"]
    assert open_picture(bundle).shape == (810, 960, 3)
    assert bundle["text/plain"] == repr(scene)


def test_an_empty_scene_is_text(scene: Scene) -> None:
    bundle = display(dataclasses.replace(scene, gaussians=empty_gaussians()))
    assert set(bundle) == {"text/plain"} and "no visible Gaussians" in bundle["text/plain"]


def test_a_rendering_is_a_picture_of_its_colours() -> None:
    color = torch.tensor((0.2, 0.5, 1.4))[:, None, None].expand(3, 32, 64).clone().requires_grad_()
    bundle = display(Rendering(color, torch.ones(32, 64), torch.ones(32, 64)))
    picture = open_picture(bundle)
    assert picture.shape == (32, 64, 3)
    assert np.abs(picture.astype(int) - (51, 128, 255)).max() <= 3
    assert bundle["text/plain"].startswith("<Rendering: 32x64, RGB")


def test_a_large_rendering_is_shown_smaller_and_other_channels_as_text() -> None:
    big = Rendering(torch.rand(3, 1024, 2048), torch.ones(1024, 2048), torch.ones(1024, 2048))
    assert open_picture(display(big)).shape == (512, 1024, 3)
    assert set(display(dataclasses.replace(big, color=big.color[:1]))) == {"text/plain"}


def test_views_and_pairs_are_pictures_of_their_panoramas(pair_folder: Path) -> None:
    (pair,) = pansplat.load_sets(pair_folder)
    assert open_picture(display(pair)).shape[:2] == (256, 1024)
    images = torch.stack([torch.zeros(3, 16, 32), torch.ones(3, 16, 32), torch.zeros(3, 16, 32)])
    poses, masks = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1), torch.ones(3, 16, 32, dtype=torch.bool)
    picture = open_picture(display(Views(images, poses, masks, 0.5, 10.0, ("a", "b", "c"))))
    assert picture.shape == (32, 64, 3)
    assert picture[8, 16].max() < 8 and picture[8, 48].min() > 247 and picture[24, 16].max() < 8


def test_a_pair_whose_files_are_missing_is_text(pair_folder: Path) -> None:
    (pair,) = pansplat.load_sets(pair_folder)
    (pair_folder / "left.png").unlink()
    assert set(display(pair)) == {"text/plain"}


def test_show_writes_a_page_and_opens_it(scene: Scene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    path = pansplat.show(scene)
    assert path is not None and opened == [path.as_uri()]
    assert path.read_text().startswith("<!doctype html>") and capsys.readouterr().err == ""
    monkeypatch.setattr("webbrowser.open", lambda url: False)
    assert str(pansplat.show(scene)) in capsys.readouterr().err


def test_show_refuses_a_scene_without_gaussians(scene: Scene) -> None:
    expect_error("no visible Gaussians", lambda: pansplat.show(dataclasses.replace(scene, gaussians=empty_gaussians())))
    expect_error("at least 1, got 0", pansplat.show, scene, gaussians=0)


class Output:
    """What a cell of a notebook shows, update by update."""

    def __init__(self) -> None:
        self.states: list[object] = []

    def display(self, value: object, **options: object) -> "Output":
        self.options = options
        self.states.append(value)
        return self

    def update(self, value: object) -> None:
        mime = value._repr_mimebundle_([], [])["text/plain"] if hasattr(value, "columns") else value.data
        self.states.append(mime)


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Output:
    """The output of a notebook's cell in which this process seems to run."""
    output = Output()
    monkeypatch.setattr("IPython.get_ipython", lambda: SimpleNamespace(kernel=object()))
    monkeypatch.setattr("IPython.display.display", output.display)
    monkeypatch.setattr(console, "_REDRAW_INTERVAL", 0.0)
    return output


def test_show_displays_the_frame_in_a_notebook(scene: Scene, cell: Output) -> None:
    assert pansplat.show(scene, gaussians=200, height=300) is None
    frame = cell.states[-1]
    assert "200 of 400 Gaussians" in frame["text/html"] and "height: 300px" in frame["text/html"]
    assert cell.options == {"raw": True}


def test_calls_show_one_bar_in_a_notebook_and_remove_it(cell, sphere_predictor, pair_folder) -> None:
    class Slow(sphere_predictor):
        def __call__(self, images: Tensor, *rest: object, **options: object) -> Gaussians:
            report_progress("placing Gaussians", 0.5)
            return super().__call__(images, *rest, **options)

    pansplat.predict(pair_folder, Slow(), cache=False, height=64)
    assert any("placing Gaussians" in str(state) and "50 %" in str(state) for state in cell.states)
    assert cell.states[-1] == "" and len([state for state in cell.states if state == ""]) == 1


def test_an_error_removes_the_bar(cell: Output, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        pansplat.predict(tmp_path / "missing")
    assert cell.states[-1] == ""


@pytest.mark.parametrize("kernel", [True, False])
def test_an_import_registers_the_displays_in_a_kernel_only(kernel: bool) -> None:
    program = f"""
import sys, types
from IPython.core.formatters import DisplayFormatter
import IPython
shell = types.SimpleNamespace(display_formatter=DisplayFormatter(), **({{"kernel": 1}} if {kernel} else {{}}))
IPython.get_ipython = lambda: shell
import pansplat
deferred = shell.display_formatter.mimebundle_formatter.deferred_printers
assert (("pansplat.gaussians.scene", "Scene") in deferred) == {kernel}, deferred
assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
