"""The command: fast help, clear errors, and a film where there is no display."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from refusals import expect_error

from pansplat_viewer import run
from pansplat_viewer.app import Options
from pansplat_viewer.capture import orbit_scene
from pansplat_viewer.core.loader import SceneEntry, choose_entry


@pytest.fixture(autouse=True)
def without_display(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def write_walk(times):
    """A path that goes ahead with 1 m/s."""
    frames = [{"seconds": t, "position": [0, 0, t], "direction": [0, 0, 1]} for t in times]
    Path("walk.json").write_text(json.dumps({"key_frames": frames}))


def test_help_needs_no_torch_and_drawing_on_the_processor_no_opengl(room):
    arguments = [str(room), "--offscreen", "out", "--renderer", "cpu", "--size", "32x32", "--seconds", "0.1"]
    code = (
        "import sys\nfrom pansplat_viewer import run\n"
        "try: run(['--help'])\nexcept SystemExit: pass\n"
        "assert not {'torch', 'moderngl', 'glfw', 'imgui_bundle'} & set(sys.modules)\n"
        f"assert run({arguments}) == 0 and 'moderngl' not in sys.modules\n"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=room.parent, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    assert "--offscreen" in result.stdout and (room.parent / "out" / "01_a.png.png").exists()


@pytest.mark.gl
def test_without_a_display_a_film_is_written_and_a_still_of_each_panorama(room, capsys):
    assert run([str(room), "--size", "96x64", "--seconds", "0.5", "--fps", "12"]) == 0
    first_line, *files = capsys.readouterr().out.splitlines()
    assert "no display" in first_line and "writing a film" in first_line
    folder, stills = room.parent / "renders" / "room", []
    names = ["01_a.png.png", "02_b.png.png", "film.mp4"]
    assert sorted(path.name for path in folder.iterdir()) == names == [Path(line).name for line in files[1:]]
    for name in names[:2]:
        with Image.open(folder / name) as image:
            stills.append(np.asarray(image).astype(int))
    with av.open(str(folder / "film.mp4")) as film:
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(video=0)]
    assert len(frames) == 6 and frames[0].shape == stills[0].shape == (64, 96, 3)
    assert np.abs(stills[0] - frames[0]).mean() < 6, "the film starts with the first still"
    assert np.abs(stills[1] - frames[-1]).mean() < 6, "the film ends with the last still"
    assert np.abs(stills[1] - frames[0]).mean() > 8


@pytest.mark.gl
def test_with_an_unusable_display_a_film_is_written(room, capsys, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":98765")
    assert run([str(room), "--size", "64x32", "--seconds", "0.2"]) == 0
    first_line = capsys.readouterr().out.splitlines()[0]
    assert "98765" in first_line and "writing a film" in first_line
    assert (room.parent / "renders" / "room" / "film.mp4").exists()


def test_without_the_libraries_of_window_and_opengl_a_film_is_written(room):
    """On a machine whose user may not install system packages: imgui needs libX11, contexts need libEGL."""
    code = (
        "import sys\n"
        "sys.modules.update(imgui_bundle=None, glfw=None, glcontext=None)\n"
        "from pansplat_viewer import run\n"
        f"sys.exit(run([{str(room)!r}, '--size', '64x32', '--seconds', '0.2']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "libraries cannot be loaded" in done.stdout and "writing a film" in done.stdout.splitlines()[0]
    assert (room.parent / "renders" / "room" / "film.mp4").exists()


def test_verbose_says_what_runs_where(write_room, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    arguments = ["--offscreen", "out", "--renderer", "cpu", "--size", "32x32", "--seconds", "0.1"]
    arguments += [str(write_room(tmp_path / "pair")), "--height", "64", "--model", "sweep", "--refine", "2"]
    assert run([*arguments, "--verbose"]) == 0
    printed = capsys.readouterr().err
    assert "note: drawing: on the processor\n" in printed and "note: refinement: on the processor\n" in printed
    assert run(arguments) == 0
    assert "note: " not in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["--offscreen", "out"]])
def test_a_path_without_a_window_is_refused(room, capsys, arguments):
    write_walk((0, 0.5))
    assert run([str(room), "--path", "walk.json", "--size", "64x32", "--seconds", "0.2", *arguments]) == 2
    assert "--path needs a window; `pansplat render SCENE --path FILE" in capsys.readouterr().err
    assert not Path("renders").exists() and not Path("out").exists(), "nothing is written"


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("out/film.mp4", ["--offscreen", "out"]),
        ("out/room/03_Attic.png", ["--offscreen", "out", "--pair", "all"]),
    ],
)
def test_a_file_of_the_user_needs_overwrite(room, capsys, name, arguments):
    write_walk((0, 0.5))
    own = Path(name)
    own.parent.mkdir(parents=True, exist_ok=True)
    own.write_bytes(b"of the user")
    assert run([str(room), *arguments, "--renderer", "cpu"]) == 2
    printed = capsys.readouterr()
    assert f"got {own}, which pansplat did not write; choose another name, or replace them with --ov" in printed.err
    assert own.read_bytes() == b"of the user" and len(list(own.parent.iterdir())) <= 3, "nothing is written"


def test_pairs_are_chosen_by_name_or_number():
    entries = [SceneEntry("bath"), SceneEntry("kitchen"), SceneEntry("hall")]
    assert choose_entry(entries, None) == 0
    assert choose_entry(entries, "kitchen") == 1
    assert choose_entry(entries, "3") == 2
    expect_error("bath, kitchen, hall", choose_entry, entries, "4")


def test_the_size_of_films_is_that_of_the_option(tmp_path):
    assert Options(tmp_path, size="1920X1080").pixels == (1920, 1080)


def test_a_scene_without_cameras_is_orbited(small_scene):
    scene = replace(small_scene, cam2world=small_scene.cam2world[:0])
    poses = [shot.pose for shot in orbit_scene(scene, 1.0, 5.0)]
    middle = np.median(scene.gaussians.means.numpy(), axis=0)
    for pose in poses:
        ahead = middle - pose[:3, 3]
        assert np.allclose(pose[:3, 2], ahead / np.linalg.norm(ahead), atol=1e-6)
    assert np.allclose(poses[0], poses[-1]) and not np.allclose(poses[0], poses[2])
