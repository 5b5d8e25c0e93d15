"""`pansplat refine`: pairs and scenes, Ctrl+C, refused arguments."""

import json
import os
import re
import signal
from pathlib import Path

import pytest

from pansplat import pipeline
from pansplat.cli import refine as refine_command
from pansplat.cli import run

HEIGHT = 64


def refine(path: Path, out: Path, *arguments: object) -> int:
    return run(["refine", str(path), "-o", str(out), "--steps", "12", *map(str, arguments)])


@pytest.mark.usefixtures("any_state")
def test_a_pair_is_predicted_and_refined(room: Path, scene: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "refined.ply"
    assert refine(room, out, "--model", "sphere", "--height", HEIGHT) == 0
    printed = capsys.readouterr().out
    assert "12 steps in" in printed and "error of all pixels" in printed
    before, after = map(float, re.search(r"pixels ([\d.]+) before, ([\d.]+) after", printed).groups())
    assert after < before
    refined, predicted = pipeline.load(out), pipeline.load(scene)
    assert refined.joint and not predicted.joint
    assert refined.names == predicted.names and refined.cam2world.equal(predicted.cam2world)


def test_a_command_says_what_runs_where_and_refuses_a_missing_card(room, scene, tmp_path, refusal, capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert refine(scene, tmp_path / "scene.ply", "--photographs", room, "--verbose") == 0
    assert "note: refinement: on the processor\n" in capsys.readouterr().err
    picture, arguments = tmp_path / "middle.png", ("--height", "32", "--overwrite")
    assert run(["render", str(scene), "-o", str(picture), "--verbose", *arguments]) == 0
    assert "note: image: on the processor\n" in capsys.readouterr().err
    assert run(["render", str(scene), "-o", str(picture), *arguments]) == 0
    assert capsys.readouterr().err == ""
    assert "`device` cuda needs a graphics card" in refusal("render", scene, "-o", picture, "--device", "cuda")


def test_layers_keep_all_gaussians(room: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "layers.ply"
    assert refine(room, out, "--model", "sphere", "--height", HEIGHT, "--layers", "--poses") == 0
    assert "error of held-out pixels" in capsys.readouterr().out
    layers = pipeline.load(out)
    assert not layers.joint and len(layers.gaussians) > 900


@pytest.mark.usefixtures("any_state")
def test_a_scene_is_refined_with_the_photographs_of_its_pair(room: Path, scene: Path, tmp_path: Path) -> None:
    assert refine(room, tmp_path / "pair.ply", "--model", "sphere", "--height", HEIGHT) == 0
    given = pipeline.load(scene)
    assert refine(scene, tmp_path / "scene.ply", "--photographs", room) == 0
    scenes = given, *(pipeline.load(tmp_path / f"{name}.ply") for name in ("pair", "scene"))
    before, a, b = (pipeline.render(each, each.pose_between(0.5), size=(32, 64)).color for each in scenes)
    # The file of the given scene is rounded, so that some other Gaussians are split.
    assert (a - b).abs().mean() < 0.25 * (a - before).abs().mean()


def test_a_budget_limits_the_gaussians(room: Path, tmp_path: Path, capsys) -> None:
    assert refine(room, tmp_path / "small.glb", "--model", "sphere", "--height", HEIGHT, "--gaussians", 300) == 0
    assert len(pipeline.load(tmp_path / "small.glb").gaussians) <= 300
    assert "(given: 1,024)" in capsys.readouterr().out


def test_a_single_view_is_written_as_it_is(room: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("pansplat.refinement.Refinement.step", None)
    photograph, out = room / "a.png", tmp_path / "refined.ply"
    options = ["--model", "sphere", "--height", HEIGHT]
    assert refine(photograph, out, *options) == 0
    printed = capsys.readouterr().out
    assert printed.count("a single view is not refined") == 1 and printed.startswith("0 steps in")
    assert run(["predict", str(photograph), "-o", str(tmp_path / "scene.ply"), *map(str, options)]) == 0
    assert out.read_bytes() == (tmp_path / "scene.ply").read_bytes()
    assert refine(photograph, tmp_path / "few.ply", *options, "--gaussians", 100) == 0
    assert len(pipeline.load(tmp_path / "few.ply").gaussians) <= 100


@pytest.mark.usefixtures("any_state")
def test_ctrl_c_ends_the_refinement_and_writes_the_scene(room: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    from pansplat.refinement import Refinement

    step = Refinement.step

    def interrupted_step(self: Refinement, fraction: float) -> None:
        step(self, fraction)
        if self._steps == 10:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Refinement, "step", interrupted_step)
    before = signal.getsignal(signal.SIGINT)
    assert refine(room, tmp_path / "out.ply", "--model", "sphere", "--height", HEIGHT) == 0
    assert "10 steps in" in (printed := capsys.readouterr().out) and "interrupted" in printed
    assert (tmp_path / "out.ply").exists() and signal.getsignal(signal.SIGINT) is before
    with refine_command.stop_at_interrupt(), pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)


def test_a_scene_needs_the_photographs_of_its_own_pair(scene: Path, tmp_path: Path, write_room, refusal) -> None:
    poses = json.loads((write_room(tmp_path / "other") / "poses.json").read_text())
    poses["poses"]["b.png"]["cam2world"][0][3] = 2.0
    (tmp_path / "other" / "poses.json").write_text(json.dumps(poses))
    message = refusal("refine", scene, "-o", tmp_path / "x.ply", "--photographs", tmp_path / "other")
    assert "differ by up to 1" in message
