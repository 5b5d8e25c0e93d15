"""The `pansplat-homes` command: help, refusals and a run of each command that renders."""

import json
import zipfile
from pathlib import Path

import pytest

from pansplat.inputs.folders import load_sets
from pansplat_homes.__main__ import run

COMMANDS = ("homes", "photographs", "flights", "triplets", "maps", "train-depth", "train-sharpening", "convert-matcher")


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_describes_each_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        run([*command.split(), "--help"])
    text = capsys.readouterr().out
    assert done.value.code == 0
    assert f"pansplat-homes {command}".strip() in text
    assert command or all(f"• {name}" in text for name in COMMANDS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("homes --out shards --count 0", "--count: needed"),
        ("homes --out shards --cameras 1", "--cameras: needed"),
        ("homes --out shards --height 100", "--height: needed"),
        ("homes --out shards --workers 0", "--workers: needed"),
        ("homes --out file", "--out file"),
        ("photographs --out x --height 100", "--height: needed"),
        ("flights --out x --seed -1", "--seed: needed"),
        ("maps none --out x", "needed at least 16 rendered triplets"),
        ("train-depth --out x --tours none", "needed shards of tours"),
        ("train-sharpening --out file --tours none", "--out file"),
        ("convert-matcher none.pth none.pth", "none.pth"),
    ],
)
def test_invalid_arguments_are_errors_without_a_traceback(
    arguments: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert run(arguments.split()) == 2
    output = capsys.readouterr().err
    assert "error: " in output and message in output and "Traceback" not in output


@pytest.mark.slow
def test_commands_write_folders_and_say_what(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["photographs", "-o", str(tmp_path / "p"), "--count", "1", "--height", "256"]) == 0
    photographs = len(json.loads((tmp_path / "p" / "home_000" / "poses.json").read_text())["poses"])
    assert f"{photographs} photographs of 1 homes" in capsys.readouterr().out
    assert run(["flights", "-o", str(tmp_path / "f"), "--count", "1", "--height", "64"]) == 0
    assert "1 flights of " in capsys.readouterr().out
    assert len(load_sets(tmp_path / "f" / "flight_00")) == 1
    assert run(["homes", "-o", str(tmp_path / "h"), "--count", "1", "--height", "32", "--cameras", "2"]) == 0
    assert "1 new shards" in capsys.readouterr().out
    assert zipfile.is_zipfile(tmp_path / "h" / "shard_00000.npz")
