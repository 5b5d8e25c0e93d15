"""gpu.sh: its commands take the options that it gives, and its table has what they print."""

import re
import runpy
from pathlib import Path

import pytest

from pansplat import cli
from pansplat.cli.refine import _describe
from pansplat.refinement import RefineReport
from pansplat_homes import __main__ as homes

RECIPE = Path(__file__).parents[1]
CALL = re.compile(r"\$bin/(pansplat[\w-]*) ([a-z-]+(?: raster|\$name)?)(.*)")


def test_every_option_of_the_script_exists(capsys: pytest.CaptureFixture[str]) -> None:
    script = (RECIPE / "gpu.sh").read_text().replace("\\\n", " ").replace("bench $suite", "bench raster")
    (common,) = re.findall(r"common=\((.*)\)", script)
    calls = CALL.findall(script.replace("${common[@]}", common).replace("train-$name", "train-depth"))
    assert len(calls) == 7
    for program, command, given in calls:
        with pytest.raises(SystemExit):
            (cli.run if program == "pansplat" else homes.run)([*command.split(), "--help-all"])
        known = re.findall(r"(?<![\w-])--?\w[\w-]*", capsys.readouterr().out)
        assert set(re.findall(r"(?<= )--?[a-z][\w-]*", given.split(" > ")[0])) <= set(known), command


def test_the_table_has_the_errors_that_the_command_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = RefineReport(40, 40, 8.0, "done", 0.05, 0.04)
    (tmp_path / "steps-cpu.log").write_text(f"note: x\n{_describe(report, 'held-out')}\nx.ply: 9 Gaussians\n")
    (tmp_path / "steps-cpu.seconds").write_text("12\n")
    runpy.run_path(str(RECIPE / "devices.py"))["main"](tmp_path)
    assert capsys.readouterr().out.splitlines()[-1] == "| refine, steps | cpu | 12 | 40 | 0.2000 | 0.0500 | 0.0400 |"
