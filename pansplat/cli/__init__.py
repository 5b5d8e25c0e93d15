"""The `pansplat` command. Each module is named after its subcommand and holds its arguments and its handler."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Protocol

from pansplat.console import exit_process, own_warnings, parse_arguments, run_command


class Command(Protocol):
    """A subcommand with its arguments."""

    def run(self) -> int:
        """Run the command and return its exit status."""
        ...


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command and exit with its status (docs/errors.md)."""
    exit_process(run(argv))


def run(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; help and misspelt arguments raise SystemExit."""

    def run_parsed() -> int:
        from pansplat.options import check_numbers

        command = parse(argv)
        check_numbers(command)
        with own_warnings():
            return command.run()

    return run_command(
        run_parsed,
        memory_advice="choose a smaller height or size.",
        interruption="no incomplete file is left behind",
    )


def parse(argv: Sequence[str] | None = None) -> Command:
    """The command of the arguments; prints help or an error and exits if there is none."""
    import tyro

    kind: Any = _list_commands()
    return parse_arguments(
        lambda: tyro.cli(
            kind,
            args=argv,
            prog="pansplat",
            description="Predict a scene of 3D Gaussians from two posed 360-degree panoramas, render and evaluate it.",
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    )


def _list_commands() -> object:
    """The union of all commands. They are imported after the signals are caught."""
    from tyro.conf import subcommand

    from pansplat.cli.batch import Batch
    from pansplat.cli.bench import Bench
    from pansplat.cli.check import Check
    from pansplat.cli.convert import Convert
    from pansplat.cli.data import Data
    from pansplat.cli.evaluate import Evaluate
    from pansplat.cli.export import Export
    from pansplat.cli.info import Info
    from pansplat.cli.pose import Pose
    from pansplat.cli.predict import Predict
    from pansplat.cli.refine import Refine
    from pansplat.cli.render import Render

    return (
        Annotated[Predict, subcommand("predict")]
        | Annotated[Refine, subcommand("refine")]
        | Annotated[Render, subcommand("render")]
        | Annotated[Export, subcommand("export")]
        | Annotated[Batch, subcommand("batch")]
        | Annotated[Evaluate, subcommand("evaluate")]
        | Annotated[Pose, subcommand("pose")]
        | Annotated[Check, subcommand("check")]
        | Annotated[Info, subcommand("info")]
        | Annotated[Bench, subcommand("bench")]
        | Annotated[Convert, subcommand("convert")]
        | Annotated[Data, subcommand("data")]
    )
