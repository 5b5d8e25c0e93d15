"""The `pansplat` command. Each module is named after its subcommand and holds its arguments and its handler."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.conf import subcommand

from pansplat.cli.bench import Bench
from pansplat.cli.check import Check
from pansplat.cli.convert import Convert
from pansplat.cli.data import Data
from pansplat.cli.evaluate import Evaluate
from pansplat.cli.info import Info
from pansplat.cli.predict import Predict
from pansplat.cli.refine import Refine
from pansplat.cli.render import Render
from pansplat.console import own_warnings, run_command

Command = (
    Annotated[Predict, subcommand("predict")]
    | Annotated[Refine, subcommand("refine")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Check, subcommand("check")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Convert, subcommand("convert")]
    | Annotated[Data, subcommand("data")]
)


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 1 a failed check, 2 bad input, 130 interrupted."""
    sys.exit(run(argv))


def run(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; invalid arguments exit with status 2."""
    command = parse(argv)
    with own_warnings():
        return run_command(
            command.run,
            memory_advice="choose a smaller height or size.",
            interruption="no incomplete file is left behind",
        )


def parse(argv: Sequence[str] | None = None) -> Command:
    """The command of the arguments; prints help or an error and exits if there is none."""
    return tyro.cli(
        Command,
        args=argv,
        prog="pansplat",
        description="Predict a scene of 3D Gaussians from two posed 360-degree panoramas, render and evaluate it.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
