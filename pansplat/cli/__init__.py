"""The `pansplat` command. Each module is named after its subcommand and holds its arguments and its handler."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from typing import Annotated, Any, Protocol, Union

from pansplat.errors import InputError
from pansplat.system.console import own_warnings, parse_arguments, print_message, run_command
from pansplat.system.devices import use_device

_COMMANDS = (
    "predict", "refine", "render", "export", "batch", "evaluate", "pose", "check", "info", "bench", "convert"
)  # fmt: skip
"""Each is a module with a class of its name, in the order of `pansplat --help`."""


class Command(Protocol):
    """A subcommand with its arguments."""

    def run(self) -> int:
        """Run the command and return its exit status."""
        ...


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command and exit with its status (docs/errors.md)."""
    sys.exit(run(argv))


def run(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; help and misspelt arguments raise SystemExit."""

    def run_parsed() -> int:
        from pansplat.prediction_options import choose_caches
        from pansplat.system.options import check_numbers

        command = parse(argv)
        check_numbers(command)
        say = partial(print_message, "note") if getattr(command, "verbose", False) else None
        with own_warnings(), use_device(getattr(command, "device", None), say), choose_caches(command):
            return command.run()

    return run_command(
        run_parsed, memory_advice="choose a smaller height or size.", interruption="no incomplete file is left behind"
    )


def parse(argv: Sequence[str] | None = None) -> Command:
    """The command of the arguments; prints help or an error and exits if there is none."""
    import tyro

    first = next(iter(sys.argv[1:] if argv is None else argv), "-")
    if not first.startswith("-") and first not in _COMMANDS:
        near = "".join(f" (did you mean {name}?)" for name in get_close_matches(first, _COMMANDS, n=1))
        raise InputError(f"needed a command, got {first!r}{near}; the commands are {', '.join(_COMMANDS)}")
    kind: Any = _list_commands()
    return parse_arguments(
        lambda args: tyro.cli(
            kind,
            args=args,
            prog="pansplat",
            description="Predict a scene of 3D Gaussians from 360-degree panoramas, render and export it. "
            "Also: pansplat --version.",
            config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
        ),
        "pansplat",
        argv,
    )


def _list_commands() -> object:
    """The union of all commands. They are imported after the signals are caught."""
    from tyro.conf import subcommand

    modules = {name: import_module(f"pansplat.cli.{name}") for name in _COMMANDS}
    kinds = [Annotated[getattr(module, name.title()), subcommand(name)] for name, module in modules.items()]
    return Union[tuple(kinds)]  # noqa: UP007, a union of a computed list
