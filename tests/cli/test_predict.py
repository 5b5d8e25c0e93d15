"""`pansplat predict`: the written scene, the chosen pair, refused arguments."""

from pathlib import Path

import torch

from pansplat import pipeline
from pansplat.cli import run
from pansplat.prediction_options import PredictOptions


def test_the_named_pair_of_a_folder_is_predicted_or_the_first(tmp_path: Path, write_room, refusal, capsys) -> None:
    for name in ("hall", "kitchen"):
        write_room(tmp_path / "pairs" / name)
    start = [
        "predict",
        str(tmp_path / "pairs"),
        "-o",
        str(tmp_path / "s.ply"),
        "--model",
        "sphere",
        "--height",
        "64",
        "--refine",
        "0",
    ]
    assert run(start) == 0
    assert "holds 2 pairs, using the first (--pair takes: 1: hall, 2: kitchen)" in capsys.readouterr().err
    for choice in ("kitchen", "2"):
        assert run([*start, "--pair", choice]) == 0
        assert capsys.readouterr().err == ""
    assert "holds 1: hall, 2: kitchen" in refusal(*start, "--pair", "attic")


def test_each_surface_is_written_once_and_fitted_to_the_photographs(room: Path, tmp_path: Path) -> None:
    """The spheres around both cameras: the part of each inside the other one is nearer to the other camera."""
    command = ["predict", str(room), "--model", "sphere", "--height", "64", "--no-cache", "-o"]
    scenes = {}
    for name, *options in (("layers", "--layers"), ("once", "--refine", "0"), ("refined", "--refine", "20")):
        assert run([*command, str(tmp_path / f"{name}.ply"), *options]) == 0
        scenes[name] = pipeline.load(tmp_path / f"{name}.ply")
    assert [scene.joint for scene in scenes.values()] == [False, True, True]
    assert len(scenes["once"].gaussians) < 0.9 * len(scenes["layers"].gaussians)
    (pair,) = pipeline.load_sets(room)
    views = pair.load_context(64)

    def measure_error(name: str) -> float:
        images = [pipeline.render(scenes[name], pose, blend="joint", size=(64, 128)).color for pose in views.cam2world]
        return float((torch.stack(images) - views.images).abs().mean())

    assert measure_error("refined") < measure_error("once") < measure_error("layers")


def test_the_default_refinement_has_more_steps_for_joint_drawing_of_many_photographs(
    room: Path, tmp_path: Path, monkeypatch
) -> None:
    steps = []

    def record(*args, options: PredictOptions, **others) -> int:
        steps.append(options.refine_steps)
        return 0

    monkeypatch.setattr(pipeline, "predict_to_file", record)
    for options in ([], ["--layers"], ["--refine", "3"]):
        assert run(["predict", str(room), "--model", "sphere", "-o", str(tmp_path / "x.ply"), *options]) == 0
    assert steps == [None, 0, 3]
    assert pipeline.prediction.choose_refine_steps(8, joint=True) > pipeline.prediction.choose_refine_steps(8)
