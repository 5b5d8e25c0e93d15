"""What all commands share: help, version, completion, refused arguments, notes, interruptions and exit statuses."""

import io
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import pansplat
from pansplat.cli import run
from pansplat.errors import InputError, InputWarning
from pansplat.system.console import own_warnings
from pansplat.training.__main__ import run as train


def test_help_and_version_are_printed_without_torch() -> None:
    names = ["predict", "render", "refine", "export", "pose", "batch", "evaluate", "check", "info", "convert"]
    names += [f"bench {name}" for name in ("raster", "model", "refine", "viewer", "pose")]
    program = (
        "import importlib, sys\nfrom pansplat.cli import run\n"
        "def end(run, words):\n"
        "    try: run(words)\n    except SystemExit as stop: assert stop.code == 0, stop.code\n"
        "    else: sys.exit('no exit')\n"
        f"for name in ['', 'bench', *{names}]: end(run, [*name.split(), '--help'])\n"
        "heavy = {'torch', 'numpy', 'scipy', 'cv2', 'numba', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "for name in ('pansplat.cli', 'pansplat_viewer', 'pansplat.training.__main__'):\n"
        "    end(importlib.import_module(name).run, ['--version'])\n"
        "assert 'torch' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(f"usage: pansplat {name} " in done.stdout for name in names)
    commands = ("pansplat", "pansplat-view", "pansplat-train")
    assert done.stdout.endswith("".join(f"{name} {pansplat.__version__}\n" for name in commands))
    for name in commands:
        (found,) = entry_points(group="console_scripts", name=name)
        assert callable(found.load())


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_the_completion_script_completes_in_bash(capsys, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        run(["--tyro-print-completion", "bash"])
    (tmp_path / "pansplat").write_text(capsys.readouterr().out)
    expected = {"pre": "predict", "predict --mo": "--model", "bench ra": "raster"}
    expected["render x.ply --layout per"] = "perspective"
    program = f"source {tmp_path / 'pansplat'}\n"
    for words in expected:
        program += f"COMP_WORDS=(pansplat {words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMPREPLY=()\n"
        program += '_tyro_pansplat; echo "${COMPREPLY[@]}"\n'
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True)
    assert stop.value.code in (0, None) and done.stderr == ""
    assert done.stdout.split("\n")[:-1] == [*expected.values()], "and no words of descriptions"


@pytest.mark.parametrize("command", ["render", "export", "predict", "check", "evaluate"])
def test_help_ends_in_a_narrow_terminal_and_has_plain_headings(command: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "2")
    with pytest.raises(SystemExit):
        run([command, "--help-all"])
    headings = [line for line in capsys.readouterr().out.splitlines() if line.rstrip().endswith(" options")]
    assert os.environ["COLUMNS"] == "2" and len(headings) > 1
    assert not any("." in line or "options options" in line for line in headings)


@pytest.mark.parametrize(
    ("command", "encoding"), [((run, "export"), "utf-8"), ((run, "export"), "ascii"), ((train, "tiny"), "utf-8")]
)
def test_help_of_a_long_command_begins_with_what_is_needed_and_names_every_option(command, encoding, monkeypatch):
    """`--help-all` describes each."""
    texts = []
    for option in ("--help", "--help-all"):
        stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr("sys.stdout", stream)
        with pytest.raises(SystemExit):
            command[0]([command[1], option])
        stream.seek(0)
        texts.append(stream.read())
    short, every = texts
    assert short.count("\n") < 60 < 120 < every.count("\n") and "--help-all" in short
    if command[1] == "export":
        assert short.index("--out PATH") < short.index("--overwrite") < short.index("--refine")
    options = set(re.findall(r"^(?:│ |  )(--\w[\w.-]*)", every, re.MULTILINE))
    assert len(options) > 25 and options <= set(re.findall(r"--[a-z][\w.-]*", short))


# Commands (`room`: a folder of panoramas, `scene.ply`: a scene), and what their message has.
REFUSED = {
    "exprot x": "needed a command, got 'exprot' (did you mean export?); the commands are predict, ",
    "zzz x": "got 'zzz'; the commands are predict, ",
    "info gone.ply": "got no such file; check the path",
    "predict room -o scene.obj": "--out must end in .compressed.ply, .spz, .splat, .sog, .glb, .ply",
    "predict room -o x.ply --model magic": "must be one of default, sphere, sweep",
    "predict room -o x.ply --near 9 --far 3": "0 < near < far",
    "predict room -o x.ply --convention sideways": "needed a known pose convention",
    "predict room -o x.ply --model sphere --precision bfloat16": "`precision` is for networks, and sphere is not one",
    "refine room -o x.ply --seconds 0": "--seconds: needed a number > 0",
    "refine room -o x.ply --photographs elsewhere": "--photographs is for a scene file",
    "refine room -o x.ply --model sphere --poses": "add --layers",
    "refine scene.ply -o x.ply": "give the folder of its pair with --photographs",
    "refine scene.ply -o x.png --photographs room": ".splat, .sog, .glb, .ply",
    "render scene.ply -o x.tiff": "--out must end in",
    "render scene.ply -o no/x.png": "needed an existing folder",
    "render scene.ply -o x.png --at 0.5 --pose path.txt": "give one of them",
    "render scene.ply -o x.mp4 --pose path.txt --path walk.json": "--pose and --path set the camera",
    "render scene.ply -o x.png --path walk.json": "--out must end in .mp4",
    "render scene.ply -o x.png --pose path.txt": "path.txt: needed JSON",
    "render scene.ply -o x.mp4 --at 0.5": "--at is one position",
    "render scene.ply -o x.mp4 --pose p.json": "--pose is one position",
    "render room -o x.png --at 1.5": "--at: needed a number <= 1.0, got 1.5",
    "render scene.ply -o x.jpg --depth": "--depth writes a .png",
    "render scene.ply -o x.png --blend mixed": "--blend must be",
    "render scene.ply -o x.png --blend view7": "from 0 to 1, got 7",
    "export scene.ply -o x.ply --serve": "--serve is for an .html page, got x.ply",
    "export scene.ply -o x.ply --photo-height 1024": "--photo-height is for an .html page, got x.ply",
    "export room -o x.html --address https://a.b": "--address: needed https://... and a folder",
    "export scene.ply -o x.stl": ".sog, .glb, .ply",
    "export scene.ply -o x.spz --points": "--points is for a .ply",
    "export scene.ply -o x.ply --crop a 0 0 1 1 1": "--crop",
    "export scene.ply -o x.ply --layers --crop 50 50 50 60 60 60": "scene.ply: needed a box with Gaussians, got (50.00",
    "export scene.ply -o x --training-set": "needed the folder of the panoramas to write their cube faces",
    "export room -o room --training-set": "needed a new or empty folder, got one with files",
    "export room -o x --training-set --crop 0 0 0 1 1 1": "--remove-floaters are not for a folder to train from",
    "evaluate -o x": "at least one folder",
    "evaluate room -o x --model sphere --lpips vgg": "LPIPS with vgg needed vgg16-397923af",
    "convert path.txt -o x.ckpt": "--out must end in .safetensors",
}


def test_refused_arguments_are_one_line_with_status_2_and_write_nothing(room, scene, tmp_path, refusal, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PANSPLAT_LPIPS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    Path("path.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    for line, message in REFUSED.items():
        options = ["--refine", "0"] if line.startswith("export room") else []
        assert message in refusal(*line.split(), *options), line
        assert not list(tmp_path.glob("x*")), line


def test_a_warning_of_pansplat_is_one_note(room: Path, predict, tmp_path: Path, capsys) -> None:
    content = json.loads((room / "poses.json").read_text())
    content["poses"]["b.png"] = content["poses"]["a.png"]  # coincident cameras
    (room / "poses.json").write_text(json.dumps(content))
    assert predict() == 0
    err = capsys.readouterr().err
    assert err.startswith("note: ") and "at one place" in err and err.count("\n") == 1
    assert (tmp_path / "scene.ply").exists()


def test_equal_notes_are_printed_once_and_warning_filters_are_restored(scene: Path, capsys) -> None:
    shown, filters = warnings.showwarning, list(warnings.filters)
    with own_warnings():
        for text in ("first", "second", "first"):
            warnings.warn(text, InputWarning, stacklevel=2)
    assert capsys.readouterr().err.splitlines() == ["note: first", "note: second"]
    run(["info", str(scene)])
    assert warnings.showwarning is shown and list(warnings.filters) == filters


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 2, "error: out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: ..."), 2, "error: out of memory"),
        (RuntimeError("a defect"), 70, "error: internal error (RuntimeError: a defect)"),
    ],
)
@pytest.mark.parametrize("debug", ["0", "1"])
def test_what_ends_a_command_is_one_line_without_a_file_and_a_traceback_is_shown_for_debugging(
    predict, sphere_model: type, capsys, monkeypatch, tmp_path: Path, error: Exception, status: int, message: str, debug
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(sphere_model, "__call__", fail)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("PANSPLAT_DEBUG", debug)
    before = sorted(os.listdir(tmp_path))
    assert predict() == status
    printed = capsys.readouterr().err
    assert ("Traceback" in printed) == (debug == "1")
    line = printed.splitlines()[-1]
    assert line.startswith(message) and (debug == "1" or printed.count("\n") == 1)
    if status == 70:
        log = Path(line.split("the log ")[1].split(";")[0])
        assert "RuntimeError: a defect" in log.read_text() and "Traceback" in log.read_text()
        log.unlink()
    assert sorted(os.listdir(tmp_path)) == before


def test_main_exits_with_the_status_of_the_command_after_the_registered_functions() -> None:
    program = """
import atexit, sys, pansplat.cli
atexit.register(print, "functions at the exit ran")
pansplat.cli.run = lambda argv: 3
pansplat.cli.main([])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (3, "functions at the exit ran\n", "")
    assert issubclass(InputError, ValueError)


@pytest.mark.skipif(sys.platform != "linux", reason="needs file names of any bytes")
def test_a_name_that_is_no_text_is_refused_with_its_bytes(tmp_path: Path, write_pair, capsys) -> None:
    folder = write_pair(tmp_path / "pair")
    odd = os.fsdecode(b"caf\xe9.png")
    shutil.copy(folder / "left.png", folder / odd)
    for command, path in (("check", folder), ("pose", folder), ("check", folder / odd)):
        assert run([command, str(path)]) == 2
        err = capsys.readouterr().err
        assert "caf\\udce9" in err and "needed a name in UTF-8, got other bytes; rename" in err and err.count("\n") == 1
