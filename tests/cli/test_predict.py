"""`pansplat predict`: the written scene, the chosen pair, refused arguments."""

from pathlib import Path

import torch

from pansplat import pipeline
from pansplat.cli import run
from pansplat.cli.inputs import PairChoice, choose_source
from pansplat.system.devices import measure_free_memory

SPHERE = ["--model", "sphere", "--height", "64", "--refine", "0"]


def test_the_named_pair_of_a_folder_is_predicted_or_the_first(tmp_path: Path, write_room, refusal, capsys) -> None:
    for name in ("hall", "kitchen"):
        write_room(tmp_path / "pairs" / name)
    start = ["predict", str(tmp_path / "pairs"), "-o", str(tmp_path / "s.ply"), *SPHERE]
    assert run(start) == 0
    assert "holds 2 pairs, using the first (--pair takes: 1: hall, 2: kitchen)" in capsys.readouterr().err
    for choice in ("kitchen", "2"):
        assert run([*start, "--pair", choice]) == 0
        assert capsys.readouterr().err == ""
    assert "holds 1: hall, 2: kitchen" in refusal(*start, "--pair", "attic")


def test_a_folder_of_three_panoramas_is_predicted_as_a_tour(tmp_path: Path, write_tour, capsys) -> None:
    command = ["predict", str(write_tour(tmp_path / "house", height=64)), *SPHERE, "-o"]
    assert run([*command, str(tmp_path / "house.glb")]) == 0
    printed = capsys.readouterr()
    assert "a tour of 3 panoramas" in printed.err and "Gaussians of 3 panoramas" in printed.out
    fused = pipeline.load(tmp_path / "house.glb")
    assert fused.joint and len(fused.cam2world) == 3 and len(fused.gains) == 3
    assert run([*command, str(tmp_path / "layers.glb"), "--layers"]) == 0
    layers = pipeline.load(tmp_path / "layers.glb")
    assert not layers.joint and len(layers.gaussians) > len(fused.gaussians)
    assert run([*command, str(tmp_path / "pair.glb"), "--pair", "2"]) == 0
    assert len(pipeline.load(tmp_path / "pair.glb").cam2world) == 2


def test_a_command_says_what_memory_it_needs_if_less_is_free(room: Path, monkeypatch, capsys) -> None:
    for free, is_said in ((2e9, True), (4e9, False)):
        monkeypatch.setattr("pansplat.cli.inputs.measure_free_memory", lambda free=free: free)
        choose_source(room, PairChoice())
        assert ("2.6 GB of memory, and 2.0 GB are free" in capsys.readouterr().err) == is_said
    assert measure_free_memory() > 0


def test_each_surface_is_written_once_and_fitted_to_the_photographs(room: Path, tmp_path: Path) -> None:
    """The spheres around both cameras: the part of each inside the other one is nearer to the other camera."""
    command = ["predict", str(room), "--model", "sphere", "--height", "64", "--no-cache", "-o"]
    scenes = {}
    for name, *options in (
        ("layers", "--layers", "--refine", "0"),
        ("once", "--refine", "0"),
        ("refined", "--refine", "20"),
    ):
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
