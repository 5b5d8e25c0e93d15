"""Windows and macOS, as far as fakes show it: names, locks, signals, drives and consoles."""

import ast
import errno
import json
import os
import sys
from pathlib import Path

import pytest
import torch
from refusals import expect_error

from pansplat.gaussians import formats
from pansplat.inputs.folders import load_sets
from pansplat.networks.weights import load_weights, pack_weights, save_weights
from pansplat.system import console
from pansplat.system.files import make_portable_name, require_output_folder


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")


@pytest.mark.parametrize(
    ("name", "portable"),
    [
        *[(name, "a_b") for name in ("a:b", "a\\b", "a/b", "a\tb")],
        *[("what?", "what"), ("end.", "end"), ("end ", "end"), ("", ""), ("\t", "")],
        *[("con", "_con"), ("Aux.jpg", "_Aux.jpg"), ("COM1", "_COM1"), ("nul .a", "nul_.a")],
    ],
)
def test_names_that_windows_refuses_become_portable(name: str, portable: str) -> None:
    assert make_portable_name(name) == portable


@pytest.mark.parametrize("name", ["kitchen", "Küche_2", "console", "com10", "a.b-c_d"])
def test_usual_names_stay(name: str) -> None:
    assert make_portable_name(name) == name


def test_a_picture_that_poses_name_in_other_capitals_is_one_picture(pair_folder: Path) -> None:
    content = json.loads((pair_folder / "poses.json").read_text())
    content["poses"]["LEFT.PNG"] = content["poses"].pop("left.png")
    (pair_folder / "poses.json").write_text(json.dumps(content))
    os.link(pair_folder / "left.png", pair_folder / "LEFT.PNG")  # as if the file system ignored capitals
    (pair,) = load_sets(pair_folder)
    assert sorted(view.image.name for view in pair.context) == ["LEFT.PNG", "right.png"]


def test_a_drive_that_does_not_exist_ends_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os.path, "lexists", lambda _: False)
    expect_error("needed an existing drive", lambda: require_output_folder("--out", Path("/nowhere/at/all")))


def test_weights_keep_no_hold_of_their_file(tmp_path: Path, small_config: object) -> None:
    path, numbers = tmp_path / "model.safetensors", torch.arange(1 << 16).float()
    save_weights(path, pack_weights("pansplat", small_config, {"weight": numbers}, compat="fixed"))
    tensors = load_weights(path).tensors
    with open(path, "r+b") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        file.write(b"\xff" * size)
    assert torch.equal(tensors["weight"], numbers)


def test_a_crash_without_a_message_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "_CODER", "import os; os._exit(5)")
    with pytest.raises(formats._CoderError, match="gaussforge stopped, 0x5"):
        formats._convert(b"", "ply", "spz")


def test_a_closed_pipe_ends_a_command_quietly_on_windows(windows, monkeypatch, capsys) -> None:
    monkeypatch.setattr(console, "_discard_output", lambda _: None)

    def write() -> int:
        raise OSError(errno.EINVAL, "Invalid argument")

    assert console.run_command(write, memory_advice="", interruption="") == console.CLOSED_PIPE
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("variables", "has_color"), [({}, False), ({"WT_SESSION": "1"}, True), ({"TERM": "x"}, True)])
def test_the_classic_console_of_windows_gets_no_escape_codes(windows, monkeypatch, capsys, variables, has_color):
    for name in ("WT_SESSION", "TERM", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    console.print_message("error", "text")
    assert ("\x1b" in capsys.readouterr().err) == has_color


_WITHOUT_TIES = {"np.argsort(order)", "np.argsort(placed)", "torch.argsort(torch.cat(places))"}  # permutations


def test_equal_numbers_are_in_one_order_on_every_processor() -> None:
    """NumPy's quicksort orders equal numbers otherwise with AVX-512 than with AVX2 or without either."""
    root, unstable = Path(__file__).resolve().parents[1], []
    for path in [*root.glob("pansplat/**/*.py"), *root.glob("viewer/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "argsort"):
                continue
            options = {word.arg: ast.unparse(word.value) for word in node.keywords}
            if options.get("kind") != "'stable'" and options.get("stable") != "True":
                unstable += [ast.unparse(node)] if ast.unparse(node) not in _WITHOUT_TIES else []
    assert unstable == []
