"""The commands from end to end: what they write, what they say, how they fail."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from pansplat import pipeline
from pansplat.cli import run
from pansplat.data.images import read_depth
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions

HEIGHT = 16


class Sphere:
    """One Gaussian a pixel on a sphere of 2 m round each camera."""

    name, fingerprint = "sphere", "1"

    def __call__(self, images: Tensor, cam2world: Tensor, near: float, far: float, *, masks=None, progress=None):
        if progress is not None:
            progress("thinking", 0.5)
        view, _, height, width = images.shape
        directions = pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)
        count = view * len(directions)
        return Gaussians(
            means=torch.cat([2 * directions @ p[:3, :3].T + p[:3, 3] for p in cam2world.double()]).float(),
            scales=torch.full((count, 3), 0.3),
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
            opacities=torch.full((count,), 0.9),
            harmonics=((images.flatten(2).transpose(1, 2).reshape(-1, 1, 3) - 0.5) / 0.28209479).contiguous(),
            levels=torch.arange(count) % 2,
            views=torch.arange(view).repeat_interleave(len(directions)),
        )


@pytest.fixture(autouse=True)
def sphere_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pipeline._MODELS, "sphere", Sphere)


def write_room(folder: Path, *, target: bool = True) -> Path:
    folder.mkdir(parents=True)
    random = np.random.default_rng(0)
    poses = {}
    for name, x in {"a.png": 0.0, "b.png": 1.0, "c.png": 0.5}.items():
        Image.fromarray(random.integers(0, 255, (HEIGHT, 2 * HEIGHT, 3), dtype=np.uint8)).save(folder / name)
        pose = np.eye(4)
        pose[0, 3] = x
        poses[name] = pose.tolist()
    (folder / "poses.json").write_text(json.dumps({"convention": "cam2world opencv", "poses": poses}))
    case = {"context": ["a.png", "b.png"]} | ({"target": "c.png"} if target else {})
    (folder / "pairs.json").write_text(json.dumps({"pairs": [case]}))
    return folder


def read(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.array(picture).astype(int)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return write_room(tmp_path / "room")


@pytest.fixture
def scene(room: Path, tmp_path: Path) -> Path:
    out = tmp_path / "scene.ply"
    assert run(["predict", str(room), "-o", str(out), "--model", "sphere", "--height", str(HEIGHT)]) == 0
    return out


def refusal(arguments: list[object], capsys: pytest.CaptureFixture[str]) -> str:
    """The one message of a command that must fail with status 2."""
    capsys.readouterr()
    assert run([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    assert "Traceback" not in err
    return err


# --help


def test_help_does_not_import_torch() -> None:
    program = (
        "import sys\nfrom pansplat.cli import run\n"
        "for arguments in (['--help'], ['predict', '--help'], ['render', '--help']):\n"
        "    try: run(arguments)\n    except SystemExit as stop: assert stop.code == 0, stop.code\n"
        "heavy = {'torch', 'numpy', 'scipy', 'cv2'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for command in ("predict", "render", "evaluate", "check", "info"):
        assert command in done.stdout


def test_a_missing_or_misspelt_argument_is_told_without_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["predict"], ["predikt", "x"], ["render", "x", "-o", "y.png", "--heigth", "3"]):
        with pytest.raises(SystemExit) as stop:
            run(arguments)
        assert stop.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


# predict


def test_predict_writes_the_scene(scene: Path) -> None:
    loaded = pipeline.load(scene)
    assert len(loaded.gaussians) == 2 * 2 * HEIGHT**2
    assert loaded.names == ("a", "b") and loaded.model == "sphere"


def test_predict_refuses_before_the_work(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    start = ["predict", room, "--model", "sphere", "-o"]
    assert "--out must be a .ply" in refusal([*start, tmp_path / "scene.splat"], capsys)
    assert "existing folder" in refusal([*start, tmp_path / "no" / "scene.ply"], capsys)
    assert "--height" in refusal([*start, tmp_path / "scene.ply", "--height", 7], capsys)
    assert "must be one of sphere, sweep" in refusal(
        ["predict", room, "-o", tmp_path / "s.ply", "--model", "magic"], capsys
    )
    assert "0 < near < far" in refusal([*start, tmp_path / "scene.ply", "--near", 9, "--far", 3], capsys)
    assert "needed a known pose convention" in refusal(
        [*start, tmp_path / "scene.ply", "--convention", "sideways"], capsys
    )
    assert not list(tmp_path.glob("*.ply"))


def test_a_folder_of_pairs_takes_the_first_or_the_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
        "16",
    ]
    assert run(start) == 0
    assert "holds 2 pairs, using the first (--pair takes: 1: hall, 2: kitchen)" in capsys.readouterr().err
    for choice in ("kitchen", "2"):
        assert run([*start, "--pair", choice]) == 0
        assert capsys.readouterr().err == ""
    assert "holds 1: hall, 2: kitchen" in refusal([*start, "--pair", "attic"], capsys)


def test_our_warnings_are_one_yellow_note(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Coincident cameras work, with a note."""
    content = json.loads((room / "poses.json").read_text())
    content["poses"]["b.png"] = content["poses"]["a.png"]
    (room / "poses.json").write_text(json.dumps(content))
    out = tmp_path / "s.ply"
    assert run(["predict", str(room), "-o", str(out), "--model", "sphere", "--height", "16"]) == 0
    err = capsys.readouterr().err
    assert err.startswith("note: ") and "coincide" in err and err.count("\n") == 1
    assert out.exists()


# render


def test_render_writes_a_panorama_from_a_scene_or_a_pair(scene: Path, room: Path, tmp_path: Path) -> None:
    assert run(["render", str(scene), "--at", "0.5", "-o", str(tmp_path / "a.png")]) == 0
    pair = [
        "render",
        str(room),
        "-o",
        str(tmp_path / "b.png"),
        "--model",
        "sphere",
        "--predict-height",
        str(HEIGHT),
    ]
    assert run(pair) == 0
    first, second = (read(tmp_path / name) for name in ("a.png", "b.png"))
    assert first.shape == (HEIGHT, 2 * HEIGHT, 3) and first.std() > 5
    assert np.abs(first - second).max() <= 1  # the .ply keeps float32 logits and logs


def test_render_has_all_layouts_and_blends(scene: Path, tmp_path: Path) -> None:
    sizes = {"equirect": (40, 20), "cubemap": (40, 20), "perspective": (36, 20)}
    for layout, size in sizes.items():
        out = tmp_path / f"{layout}.png"
        assert run(["render", str(scene), "-o", str(out), "--layout", layout, "--height", "20"]) == 0
        assert read(out).shape == (size[1], size[0], 3)
    pictures = []
    for blend in ("deferred", "joint", "view0", "view1"):
        assert run(["render", str(scene), "-o", str(tmp_path / "x.png"), "--blend", blend]) == 0
        pictures.append((tmp_path / "x.png").read_bytes())
    assert len(set(pictures)) == 4


def test_an_exr_holds_depth(scene: Path, tmp_path: Path) -> None:
    assert run(["render", str(scene), "--at", "0", "-o", str(tmp_path / "x.exr"), "--blend", "view0"]) == 0
    depth = read_depth(tmp_path / "x.exr", HEIGHT)
    assert float(depth.median()) == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("form", ["matrix.json", "object.json", "sixteen.txt", "kitti.txt"])
def test_render_takes_poses_in_many_forms(scene: Path, tmp_path: Path, form: str) -> None:
    pose = pipeline.load(scene).pose_between(0.25)
    text = " ".join(str(x) for x in pose.flatten().tolist())
    opengl = (pose @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))).tolist()
    content = {
        "matrix.json": json.dumps(pose.tolist()),
        "object.json": json.dumps({"convention": "cam2world opengl", "cam2world": opengl}),
        "sixteen.txt": text,
        "kitti.txt": " ".join(text.split()[:12]),
    }
    (tmp_path / form).write_text(content[form])
    assert run(["render", str(scene), "--pose", str(tmp_path / form), "-o", str(tmp_path / "p.png")]) == 0
    assert run(["render", str(scene), "--at", "0.25", "-o", str(tmp_path / "q.png")]) == 0
    difference = np.array(Image.open(tmp_path / "p.png")).astype(int) - np.array(Image.open(tmp_path / "q.png"))
    assert np.abs(difference).max() <= 1


def test_a_film_flies_between_the_cameras(scene: Path, tmp_path: Path) -> None:
    import av

    out = tmp_path / "x.mp4"
    assert run(["render", str(scene), "-o", str(out), "--height", "18", "--seconds", "0.5", "--fps", "8"]) == 0
    with av.open(str(out)) as film:
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(frames) == 4 and frames[0].shape == (18, 32, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 1


def test_render_refuses_what_makes_no_sense(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trajectory = tmp_path / "way.txt"
    trajectory.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    start, png = ["render", scene, "-o"], tmp_path / "x.png"
    assert "--out must end in" in refusal([*start, tmp_path / "x.tiff"], capsys)
    assert "folder does not exist" in refusal([*start, tmp_path / "no" / "x.png"], capsys)
    assert "give one of them" in refusal([*start, png, "--at", 0.5, "--pose", trajectory], capsys)
    assert "holds 2 poses" in refusal([*start, png, "--pose", trajectory], capsys)
    assert "--at is one position" in refusal([*start, tmp_path / "x.mp4", "--at", 0.5], capsys)
    assert "--at must be a number" in refusal([*start, png, "--at", "nan"], capsys)
    assert "--blend must be" in refusal([*start, png, "--blend", "mixed"], capsys)
    assert "from 0 to 1, got 7" in refusal([*start, png, "--blend", "view7"], capsys)
    assert "--fov must be" in refusal([*start, png, "--fov", 180], capsys)
    assert "--height" in refusal([*start, png, "--height", 0], capsys)
    assert "must be positive" in refusal([*start, tmp_path / "x.mp4", "--fps", 0], capsys)
    assert "nowhere.ply" in refusal(["render", tmp_path / "nowhere.ply", "-o", png], capsys)
    assert not png.exists()


# evaluate


def test_a_precision_reaches_the_model_wherever_one_predicts(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--model", "sphere", "--precision", "bfloat16"]
    for command, out in (("predict", "x.ply"), ("render", "x.png")):
        assert run([command, str(room), "-o", str(tmp_path / out), *arguments]) == 2
        assert "`precision` is for networks, and sphere is not one" in capsys.readouterr().err


def test_evaluate_writes_results_and_prints_the_table(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_room(tmp_path / "alone", target=False)
    arguments = [
        "evaluate",
        str(room),
        str(tmp_path / "alone"),
        "--out",
        str(tmp_path / "out"),
        "--model",
        "sphere",
    ]
    assert run([*arguments, "--height", str(HEIGHT)]) == 0
    out, err = capsys.readouterr()
    assert "WS-PSNR" in out and "cross-fade" in out and "room" in out
    assert "alone: none of its 1 pairs has a target view; skipped" in err
    (result,) = json.loads((tmp_path / "out" / "results.json").read_text())
    assert f"{result['ws_psnr']:.2f}" in out
    assert Path(result["prediction"]).is_file() and Path(result["target"]).is_file()


def test_evaluate_refuses_folders_without_targets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = write_room(tmp_path / "alone", target=False)
    capsys.readouterr()
    assert run(["evaluate", str(alone), "--out", str(tmp_path / "out"), "--model", "sphere"]) == 2
    assert "none of the pairs has a target view" in capsys.readouterr().err
    assert "at least one folder" in refusal(["evaluate", "--out", tmp_path / "out"], capsys)


# info and check


def test_info_tells_counts_and_cameras(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert run(["info", str(scene)]) == 0
    out = capsys.readouterr().out
    assert "1,024 Gaussians, SH degree 0" in out
    assert out.count("256") >= 4  # two levels of two views
    assert "opacity" in out and "median 0.9" in out
    assert "camera 1" in out and "(1.000, 0.000, 0.000) m" in out and "bounds" in out


@pytest.mark.shared
def test_check_exits_with_one_when_the_convention_is_wrong(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = str(shared / "data" / "mp3d_sample")
    assert run(["check", pair]) == 0
    assert "as given" in capsys.readouterr().out
    assert run(["check", pair, "--convention", "cam2world opencv"]) == 1
    assert "likely mistake" in capsys.readouterr().out


# interruption


def test_interrupting_exits_with_130_and_leaves_nothing(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Sphere, "__call__", interrupted)
    before = sorted(os.listdir(tmp_path))
    assert run(["predict", str(room), "-o", str(tmp_path / "s.ply"), "--model", "sphere", "--height", "16"]) == 130
    assert capsys.readouterr().err.startswith("interrupted")
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: ...")])
def test_a_lack_of_memory_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    def lacking(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(Sphere, "__call__", lacking)
    room = write_room(tmp_path / "room")
    assert run(["predict", str(room), "-o", str(tmp_path / "s.ply"), "--model", "sphere", "--height", "16"]) == 2
    told = capsys.readouterr().err
    assert "error: this takes more memory" in told and len(told.splitlines()) == 1
    assert not list(tmp_path.glob("*.ply"))


def test_other_errors_of_the_program_keep_their_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(Sphere, "__call__", broken)
    room = write_room(tmp_path / "room")
    with pytest.raises(RuntimeError, match="a defect"):
        run(["predict", str(room), "-o", str(tmp_path / "s.ply"), "--model", "sphere", "--height", "16"])


def test_warning_filters_are_as_before_after_a_command(scene: Path) -> None:
    import warnings

    shown, filters = warnings.showwarning, list(warnings.filters)
    run(["info", str(scene)])
    assert warnings.showwarning is shown and list(warnings.filters) == filters


@pytest.mark.parametrize("entry", ["pansplat", "pansplat-train"])
def test_entry_points_are_installed(entry: str) -> None:
    from importlib.metadata import entry_points

    (found,) = entry_points(group="console_scripts", name=entry)
    assert callable(found.load())


def test_main_exits_with_the_status_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    import pansplat.cli

    monkeypatch.setattr(pansplat.cli, "run", lambda argv: 3)
    with pytest.raises(SystemExit) as stop:
        pansplat.cli.main([])
    assert stop.value.code == 3


def test_input_errors_are_value_errors() -> None:
    """Notebook users who know nothing of InputError still catch it."""
    assert issubclass(InputError, ValueError)
