"""Help, errors, warnings, interruptions and exit statuses of all commands."""

import json
import os
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


def test_help_does_not_import_torch() -> None:
    program = (
        "import sys\nfrom pansplat.cli import run\n"
        "commands = ['predict', 'render', 'evaluate', 'check', 'info', 'convert', 'bench']\n"
        "benches = [['bench', name] for name in ('raster', 'model', 'memory', 'pose')]\n"
        "for arguments in ([], *([name] for name in commands), *benches):\n"
        "    try: run([*arguments, '--help'])\n    except SystemExit as stop: assert stop.code == 0, stop.code\n"
        "heavy = {'torch', 'numpy', 'scipy', 'cv2', 'numba', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for command in ("predict", "render", "evaluate", "check", "info", "convert", "bench raster", "bench pose"):
        assert f"usage: pansplat {command} " in done.stdout


@pytest.mark.parametrize("arguments", [["predict"], ["render", "x", "-o", "y.png", "--heigth", "3"]])
def test_missing_or_misspelt_arguments_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(arguments)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and "Traceback" not in err
    assert {"predict": "--out", "render": "--height"}[arguments[0]] in err


@pytest.mark.parametrize("module", ["pansplat.cli", "pansplat_viewer", "pansplat.training.__main__"])
def test_the_version_is_printed_without_torch(module: str) -> None:
    program = f"import sys\nfrom {module} import run\ntry: run(['--version'])\nexcept SystemExit as stop:\n"
    program += "    assert stop.code == 0 and 'torch' not in sys.modules\nelse: sys.exit('no exit')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    name = {"pansplat.cli": "pansplat", "pansplat_viewer": "pansplat-view"}.get(module, "pansplat-train")
    assert done.stdout == f"{name} {pansplat.__version__}\n"


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("pre", {"predict"}),
        ("predict --mo", {"--model"}),
        ("bench ra", {"raster"}),
        ("render scene.ply --layout per", {"perspective"}),
    ],
)
def test_the_completion_script_completes_in_bash(words: str, expected: set[str], capsys, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        run(["--tyro-print-completion", "bash"])
    script = tmp_path / "pansplat"
    script.write_text(capsys.readouterr().out)
    program = (
        f"source {script}; COMP_WORDS=(pansplat {words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))\n"
        '_tyro_pansplat; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True)
    assert stop.value.code in (0, None) and done.stderr == ""
    assert set(done.stdout.split()) == expected, "and no words of descriptions"


def test_a_warning_of_pansplat_is_one_note(room: Path, predict, tmp_path: Path, capsys) -> None:
    content = json.loads((room / "poses.json").read_text())
    content["poses"]["b.png"] = content["poses"]["a.png"]  # coincident cameras
    (room / "poses.json").write_text(json.dumps(content))
    assert predict() == 0
    err = capsys.readouterr().err
    assert err.startswith("note: ") and "at one place" in err and err.count("\n") == 1
    assert (tmp_path / "scene.ply").exists()


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch, sphere_model: type):
    """A function that makes the predictor raise an error."""

    def set_error(error: BaseException) -> None:
        def predict(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr(sphere_model, "__call__", predict)

    return set_error


def test_interrupting_exits_with_130_and_leaves_no_file(room: Path, predict, fail, tmp_path: Path, capsys) -> None:
    fail(KeyboardInterrupt())
    before = sorted(os.listdir(tmp_path))
    assert predict() == 130
    assert capsys.readouterr().err.startswith("interrupted")
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: ...")])
def test_too_little_memory_is_one_line(predict, fail, tmp_path: Path, capsys, error: Exception) -> None:
    fail(error)
    assert predict() == 2
    message = capsys.readouterr().err
    assert "error: out of memory" in message and len(message.splitlines()) == 1
    assert not list(tmp_path.glob("*.ply"))


def test_a_defect_is_one_line_with_a_log_of_its_traceback(
    predict, fail, capsys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    fail(RuntimeError("a defect"))
    assert predict() == 70
    message = capsys.readouterr().err
    assert message.startswith("error: internal error (RuntimeError: a defect), please report it with the log /")
    assert message.count("\n") == 1
    log = Path(message.split("the log ")[1].split(";")[0])
    assert "RuntimeError: a defect" in log.read_text() and "Traceback" in log.read_text()


def test_debugging_shows_the_traceback(predict, fail, capsys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PANSPLAT_DEBUG", "1")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    fail(RuntimeError("a defect"))
    assert predict() == 70
    assert "Traceback" in capsys.readouterr().err


def test_warning_filters_are_restored_after_a_command(scene: Path) -> None:
    shown, filters = warnings.showwarning, list(warnings.filters)
    run(["info", str(scene)])
    assert warnings.showwarning is shown and list(warnings.filters) == filters


@pytest.mark.parametrize("entry", ["pansplat", "pansplat-train"])
def test_entry_points_are_installed(entry: str) -> None:
    (found,) = entry_points(group="console_scripts", name=entry)
    assert callable(found.load())


def test_main_exits_with_the_status_of_the_command_after_the_registered_functions() -> None:
    program = """
import atexit, sys, pansplat.cli
atexit.register(print, "functions at the exit ran")
pansplat.cli.run = lambda argv: 3
pansplat.cli.main([])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (3, "functions at the exit ran\n", "")


def test_input_errors_are_value_errors() -> None:
    assert issubclass(InputError, ValueError)


def test_equal_notes_are_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    with own_warnings():
        for text in ("first", "second", "first"):
            warnings.warn(text, InputWarning, stacklevel=2)
    assert capsys.readouterr().err.splitlines() == ["note: first", "note: second"]


@pytest.mark.parametrize(
    ("word", "near"), [("exprot", " (did you mean export?)"), ("predikt", " (did you mean predict?)"), ("zzz", "")]
)
def test_an_unknown_command_is_named_with_the_nearest_one(word: str, near: str, capsys) -> None:
    assert run([word, "x"]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error: needed a command, got '{word}'{near}; the commands are predict, ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", ["render", "export", "predict", "check", "evaluate"])
def test_help_ends_in_a_narrow_terminal_and_has_plain_headings(command: str, monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "2")
    with pytest.raises(SystemExit):
        run([command, "--help"])
    text = capsys.readouterr().out
    headings = [line for line in text.splitlines() if line.rstrip().endswith(" options")]
    assert os.environ["COLUMNS"] == "2" and len(headings) > 1
    assert not any("." in line or "options options" in line for line in headings)


@pytest.mark.parametrize(
    "arguments", [["info", "gone.ply"], ["render", "gone.ply", "-o", "x.png"], ["info", "gone.spz"]]
)
def test_a_missing_file_is_said_to_be_missing(arguments: list[str], tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    assert "got no such file; check the path" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="needs file names of any bytes")
def test_a_name_that_is_no_text_is_refused_with_its_bytes(tmp_path: Path, write_pair, capsys) -> None:
    folder = write_pair(tmp_path / "pair")
    odd = os.fsdecode(b"caf\xe9.png")
    shutil.copy(folder / "left.png", folder / odd)
    for path in (folder, folder / odd):
        assert run(["check", str(path)]) == 2
        err = capsys.readouterr().err
        assert "caf\\udce9" in err and "needed a name in UTF-8, got other bytes; rename" in err and err.count("\n") == 1
