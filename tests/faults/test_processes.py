"""Signals, pipes and terminals: how a command ends when it is stopped or cannot print."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PREDICT = "predict pair -o out.ply --model sphere --height 64 --refine 0"
EVALUATE = "evaluate pair --out report --model sphere --height 64"


@pytest.mark.parametrize(
    ("command", "number"), [(PREDICT, signal.SIGINT), (PREDICT, signal.SIGTERM), (EVALUATE, signal.SIGINT)]
)
def test_a_signal_ends_a_command_quietly(command, number, attack, sphere_predictor, monkeypatch) -> None:
    monkeypatch.setattr(sphere_predictor, "__call__", lambda *_, **__: signal.raise_signal(number))
    handlers = [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)]
    outcome = attack(command.split())
    assert outcome.status == 128 + number
    assert outcome.err.startswith("interrupted: ") and outcome.err.count("\n") == 1
    assert [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)] == handlers


# Terminals and pipes: a child process that has imported the package forks for each case

_FORK_SERVER = """
import io, json, os, signal, sys
import torch, pansplat.cli, pansplat.pipeline, pansplat.system.console, rich.table, rich.progress  # before the forks
import pansplat.cli.info, pansplat.cli.predict, pansplat.evaluation.report
from pansplat.cli import main


class FromFile:  # compiles no kernels
    name, fingerprint = "file", "1"

    def __call__(self, *_, **__):
        return pansplat.pipeline.load("scene.ply").gaussians


pansplat.pipeline.models._MODELS["file"] = FromFile
for case in json.load(sys.stdin):
    if os.fork() == 0:
        os.environ.update(case["environment"])
        for name in case["unset"]:
            os.environ.pop(name, None)
        for descriptor, target in ((1, case["out"]), (2, case["err"])):
            if target == "closed":
                os.close(descriptor)
            elif target == "broken pipe":
                reader, writer = os.pipe()
                os.close(reader)
                os.dup2(writer, descriptor)
            else:
                file = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
                os.dup2(file, descriptor)
        encoding = case["encoding"]
        sys.stdout, sys.stderr = (
            None if target == "closed" else open(n, "w", -1 if n == 1 else 1, encoding, e)
            for n, e, target in ((1, "strict", case["out"]), (2, "backslashreplace", case["err"]))
        )
        sys.__stdout__, sys.__stderr__ = sys.stdout, sys.stderr
        signal.alarm(300)  # a command that hangs
        try:
            main([os.fsdecode(word.encode("latin-1")) for word in case["command"]])
        except SystemExit as stop:  # Python's finalisation takes a second with torch
            try:
                for stream in filter(None, (sys.stdout, sys.stderr)):
                    stream.flush()
            except OSError:
                stop.code = 120  # as Python itself ends
            os._exit(stop.code or 0)
    print(os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
"""


class Cases:
    """Cases for the fork server, and their ends."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.cases = folder, []

    def add(self, name: str, command: str, status: int, says: str = "", **setting: Any) -> None:
        """A command with its standard streams, encoding and environment, and its expected status and message."""
        case = {"name": name, "command": command.split(), "status": status, "says": says, "encoding": "utf-8"}
        number = len(self.cases)
        streams = {"out": str(self.folder / f"{number}.out"), "err": str(self.folder / f"{number}.err")}
        self.cases.append(case | streams | {"environment": {}, "unset": []} | setting)

    def run(self) -> list[str]:
        """Run all cases; returns what is wrong."""
        command = [sys.executable, "-c", _FORK_SERVER]
        done = subprocess.run(command, input=json.dumps(self.cases), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        wrong = []
        for case, status in zip(self.cases, map(int, done.stdout.split()), strict=True):
            texts = [
                Path(case[s]).read_bytes().decode(case["encoding"]) if Path(case[s]).is_file() else ""
                for s in ("out", "err")
            ]
            lines = [line for line in texts[1].splitlines() if not line.startswith(("note: ", "╭", "│", "╰", "+", "|"))]
            fine = status == case["status"] and case["says"] in "".join(texts) and "Traceback" not in "".join(texts)
            is_silent = not texts[0] and status == 0 and case["out"] != "closed"
            if not fine or is_silent or (len(lines) > (status != 0) and "helptext" not in texts[1]):
                wrong.append(f"{case['name']}: status {status}, {texts}")
        return wrong


@pytest.mark.slow
def test_terminals_and_pipes_end_no_command_with_a_traceback(folder: Path, tmp_path: Path) -> None:
    cases = Cases(tmp_path)
    info, full, home = "info scene.ply", "/dev/full", {"HOME": "/nowhere", "XDG_CACHE_HOME": "/proc/cache"}
    for command in (info, "predict --help"):
        cases.add(f"{command}: the reader of its output ended", command, 141, out="broken pipe")
        cases.add(f"{command}: its output is a full disk", command, 2, "No space left", out=full)
        cases.add(f"{command}: closed output", command, 0, out="closed")
    for command, status in ((info, 0), ("predict --heigth 3", 2)):
        cases.add(f"{command}: ASCII", command, status, encoding="ascii")
        cases.add(f"{command}: closed errors", command, status, err="closed")
    cases.add("info: latin-1", info, 0, encoding="latin-1")
    cases.add("an error to a full disk", "info no.ply", 2, err=full)
    cases.add("an error to a closed pipe", "info no.ply", 2, err="broken pipe")
    cases.add("no home", info, 0, environment=home)
    (folder / "pair" / ".pansplat").touch()  # no cache folder can be made there
    odd = folder / os.fsdecode(b"\xff\xfe pair".replace(b" ", b"_"))
    os.rename(folder / "pair", odd)
    odd_name = os.fsencode(odd.name).decode("latin-1")
    cases.add(
        "a pair whose name is not UTF-8, without a home and a writable cache",
        f"predict {odd_name} -o b.ply --model file --height 64 --refine 0",
        0,
        environment={"XDG_CACHE_HOME": "/proc/c"},
        unset=["HOME"],
    )
    cases.add("info: a missing name that is not UTF-8", f"info {odd_name}.ply", 2, "\\udcff")
    cases.add("info: the same, latin-1", f"info {odd_name}.ply", 2, "\\udcff", encoding="latin-1")
    wrong = cases.run()
    assert not wrong, "\n".join(wrong)
    assert not list(folder.glob(".*")), "incomplete files"


@pytest.mark.slow
def test_a_command_in_a_compiled_kernel_ends_at_ctrl_c(folder: Path, tmp_path: Path) -> None:
    program = (
        "import numba, os, signal, threading\n"
        "from pansplat import pipeline\nfrom pansplat.cli import main\n"
        "@numba.njit\ndef work(n):\n    t = 0.0\n    for i in range(n): t += i ** 0.5\n    return t\n"
        "class Slow:\n"
        "    name, fingerprint = 'slow', '1'\n"
        "    def __call__(self, *_, **__):\n"
        "        work(2)\n"
        "        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "        while True: work(30_000_000)\n"
        "pipeline.models._MODELS['slow'] = Slow\n"
        "main(['evaluate', 'pair', '--out', 'report', '--model', 'slow', '--height', '64'])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr and done.stderr.count("\n") == 1
    assert not [path for path in folder.rglob("*") if path.is_file() and "report" in str(path)]
