"""The evaluation of pairs: its files, metrics and table."""

import dataclasses
import functools
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from panorama_fixtures import write_grey
from panorama_formats import move
from PIL import Image
from rich.console import Console
from synthetic_scenes import approx_of_8_bits
from torch import Tensor

from pansplat.evaluation.lpips import Lpips
from pansplat.evaluation.metrics import psnr, ssim, ws_psnr
from pansplat.evaluation.report import evaluate, results_table
from pansplat.evaluation.results import Row
from pansplat.gaussians.scene import Gaussians
from pansplat.inputs.folders import load_sets
from pansplat.training.sequences import BoundedSampler

HEIGHT = 16
KEYS = [
    *("software", "name", "model", "height", "ws_psnr", "psnr", "ssim", "cross_fade_ws_psnr", "predict_seconds"),
    *("render_seconds", "num_gaussians", "prediction", "target", "own_ws_psnr", "refine_seconds"),
    *("distortion_ahead", "distortion_aside"),
]


def read_image(path: str | Path) -> Tensor:
    return torch.from_numpy(np.array(Image.open(path)) / np.float32(255)).permute(2, 0, 1)


@pytest.fixture(scope="module")
def write_triplet(write_room: Callable[..., Path]) -> Callable[..., Path]:
    """Write a pair with a target."""
    return functools.partial(write_room, height=HEIGHT)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, write_triplet: Callable[..., Path]) -> Path:
    """A folder with a triplet in `room`."""
    return write_triplet(tmp_path_factory.mktemp("report") / "room").parent


@pytest.fixture(scope="module")
def case(folder: Path, sphere_predictor: type) -> Row:
    """The triplet's only case, evaluated into `out`."""
    (case,) = evaluate(load_sets(folder / "room"), sphere_predictor(), folder / "out", height=HEIGHT)
    return case


def test_results_have_the_documented_fields_and_files(folder: Path, case: Row) -> None:
    (result,) = json.loads((folder / "out" / "results.json").read_text())
    assert set(result) == set(KEYS)
    found = [result[key] for key in ("name", "model", "height", "num_gaussians")]
    assert found == ["room", "sphere", HEIGHT, 4 * HEIGHT**2]
    assert {p.name for p in (folder / "out" / "room").iterdir()} == {"prediction.png", "target.png", "error.png"}


def test_metrics_are_those_of_the_written_images(folder: Path, case: Row) -> None:
    assert json.loads((folder / "out" / "results.json").read_text()) == [{"software": "pansplat", **case.as_json()}]
    prediction, target = read_image(case.get("prediction")), read_image(case.get("target"))
    torch.testing.assert_close(target, read_image(folder / "room" / "c.png"))
    assert case.get("ws_psnr") == approx_of_8_bits(ws_psnr(prediction, target))
    assert case.get("psnr") == approx_of_8_bits(psnr(prediction, target))
    assert case.get("ssim") == pytest.approx(ssim(prediction, target), abs=1e-3)
    inputs = [read_image(folder / "room" / name) for name in ("a.png", "b.png")]
    assert case.get("cross_fade_ws_psnr") == approx_of_8_bits(ws_psnr(sum(inputs) / 2, target))


def test_an_evaluation_does_not_use_the_prediction_cache(tmp_path, sphere_predictor, write_triplet) -> None:
    pairs, predictor = load_sets(write_triplet(tmp_path / "room")), sphere_predictor()
    for _ in range(2):
        evaluate(pairs, predictor, tmp_path / "out", height=HEIGHT)
    assert predictor.calls == 4 and not (tmp_path / "room" / ".pansplat").exists()  # each with a warm-up


def test_cases_of_one_name_have_own_folders_and_the_table_has_their_mean(tmp_path, sphere_predictor, write_triplet):
    pairs = [load_sets(write_triplet(tmp_path / place / "room"))[0] for place in ("x", "y")]
    cases = evaluate(pairs, sphere_predictor(), tmp_path / "out", height=HEIGHT)
    assert [case.get("name") for case in cases] == ["room", "room_2"]
    assert len({case.get("prediction") for case in cases}) == 2
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(results_table(cases))
    lines = console.export_text().splitlines()
    (mean,) = (line for line in lines if "mean" in line)
    assert f"{cases[0].get('ws_psnr'):.2f}" in mean
    below = lines[-2].replace("│", " ").split()
    assert below[:2] == ["cross-fade", f"{cases[0].get('cross_fade_ws_psnr'):.2f}"]


def test_a_masked_target_has_second_values_of_the_scene_and_the_cross_fade(tmp_path, sphere_predictor, write_triplet):
    folder = write_triplet(tmp_path / "room")
    mask = np.full((HEIGHT, 2 * HEIGHT), 255, np.uint8)
    mask[-4:] = 0
    Image.fromarray(mask).save(folder / "c_mask.png")
    (case,) = evaluate(load_sets(folder), sphere_predictor(), tmp_path / "out", height=HEIGHT)
    target, prediction = read_image(case.get("target")), read_image(case.get("prediction"))
    faded = sum(read_image(folder / name) for name in ("a.png", "b.png")) / 2
    counts = torch.from_numpy(mask > 0)
    assert case.get("masked_ws_psnr") == approx_of_8_bits(ws_psnr(prediction, target, mask=counts))
    assert case.get("ws_psnr") == approx_of_8_bits(ws_psnr(prediction, target))
    assert case.get("masked_cross_fade_ws_psnr") == approx_of_8_bits(ws_psnr(faded, target, mask=counts))
    (result,) = json.loads((tmp_path / "out" / "results.json").read_text())
    assert set(result) == {*KEYS, "masked_ws_psnr", "masked_cross_fade_ws_psnr"}
    assert "unmasked" in [str(column.header) for column in results_table([case]).columns]


@pytest.mark.filterwarnings("ignore:a, b. the cameras are at one place")
def test_torn_surfaces_are_columns_of_cameras_at_two_places(folder, case, tmp_path, write_triplet, sphere_predictor):
    class TornPredictor(sphere_predictor):  # every second block is nearer
        def __call__(self, images: Tensor, cam2world: Tensor, *arguments, **options) -> Gaussians:
            found = super().__call__(images, cam2world, *arguments, **options)
            eyes = cam2world[found.views.long(), :3, 3].float()
            factor = 1 + 0.4 * torch.sin(5 * (found.means - eyes)).sign().prod(dim=1, keepdim=True)
            return dataclasses.replace(found, means=eyes + factor * (found.means - eyes))

    (torn,) = evaluate(load_sets(folder / "room"), TornPredictor(), tmp_path / "torn", height=64)
    assert torn.get("distortion_aside") > 0.02 > 1e-3 > case.get("distortion_aside")
    headings = [str(column.header) for column in results_table([torn]).columns]
    assert "torn aside" in headings
    pairs = load_sets(write_triplet(tmp_path / "room", baseline=0.0))
    (still,) = evaluate(pairs, TornPredictor(), tmp_path / "still", height=64)
    assert still.get("distortion_ahead") is None is still.get("distortion_aside")
    assert "torn aside" not in [str(column.header) for column in results_table([still]).columns]


def test_lpips_is_optional(folder: Path, tmp_path: Path, sphere_predictor: type) -> None:
    pairs, metric = load_sets(folder / "room"), Lpips("squeeze")
    for head in metric.heads:
        head.data.fill_(0.1)
    (case,) = evaluate(pairs, sphere_predictor(), tmp_path / "out", height=32, lpips=metric)
    (result,) = json.loads((tmp_path / "out" / "results.json").read_text())
    assert set(result) == {*KEYS, "lpips", "cross_fade_lpips"} and result["lpips"] == case.get("lpips")
    target = read_image(case.get("target"))
    assert case.get("lpips") == pytest.approx(metric.distance(read_image(case.get("prediction")), target), abs=1e-3)
    context = pairs[0].load_context(32)
    assert case.get("cross_fade_lpips") == pytest.approx(metric.distance(context.images.mean(0), target), abs=1e-3)
    assert "LPIPS" in [str(column.header) for column in results_table([case]).columns]


@pytest.mark.usefixtures("any_state")
def test_a_refined_scene_is_evaluated_with_its_time_and_error_at_the_inputs(tmp_path, sphere_predictor, write_triplet):
    pairs = load_sets(write_triplet(tmp_path / "room"))
    options = {"height": HEIGHT, "blend": "joint"}  # of random images, held-out blocks say nothing
    plain, refined = (
        evaluate(pairs, sphere_predictor(), tmp_path / str(steps), refine_steps=steps, **options)[0]
        for steps in (0, 10)
    )
    assert plain.get("refine_seconds") == 0 < refined.get("refine_seconds")
    assert refined.get("own_ws_psnr") > plain.get("own_ws_psnr") > 5
    headings = [str(column.header) for column in results_table([refined]).columns]
    assert "at inputs" in headings and "refine s" in headings


def test_the_documented_script_states_the_papers_pairs_of_360loc(tmp_path, monkeypatch) -> None:
    """docs/evaluation.md: the official inputs, targets and range, and without detection of what moves with a camera."""
    for frame in range(120):
        write_grey(tmp_path / "image" / f"{frame}.png", frame / 120)
    poses = {f"{frame}.png": move(0.2 * frame) for frame in range(120)}
    (tmp_path / "camera_pose.json").write_text(json.dumps(poses))
    Image.new("L", (16, 8), 255).save(tmp_path / "mask.png")
    text = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text()
    script = text.split("```python\n")[1].split("```")[0]
    monkeypatch.setattr("sys.argv", ["-c", str(tmp_path)])
    exec(script, {})
    pairs = load_sets(tmp_path)
    with_targets = [([view.name for view in pair.context], [view.name for view in pair.targets]) for pair in pairs]
    expected = BoundedSampler().evaluation(120)
    named = [([f"{each.left}", f"{each.right}"], [f"{frame}" for frame in each.targets]) for each in expected]
    assert with_targets == named
    assert len(pairs) == 100 and {pair.far for pair in pairs} == {50} and pairs[0].load_context(8).masks.all()
