"""The `pansplat` command."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.cli.commands import Command


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 1 a check that failed, 2 bad input, 130 interrupted."""
    sys.exit(run(argv))


def run(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; unusable arguments exit with status 2."""
    command = parse(argv)
    with warnings.catch_warnings():
        # What the libraries below warn of is for their users; what we warn of is for ours.
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"pansplat(\.|$)")
        warnings.showwarning = _show_warning
        try:
            return command.run()
        except InputError as error:
            _say("red", "error", error)
            return 2
        except (MemoryError, RuntimeError) as error:
            if not _lacks_memory(error):
                raise
            _say("red", "error", "this takes more memory than the machine has free; choose a smaller height or size.")
            return 2
        except KeyboardInterrupt:
            _say("red", "interrupted", "nothing half-written is left behind")
            return 130


def parse(argv: Sequence[str] | None = None) -> Command:
    """The command that the arguments ask for; else prints help or what is wrong with them, and exits."""
    import tyro

    from pansplat.cli.commands import Command

    return tyro.cli(
        Command,
        args=argv,
        prog="pansplat",
        description="Two posed 360-degree panoramas in, a scene of 3D Gaussians you can fly through out.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def _show_warning(message: Warning | str, *_: object) -> None:
    _say("yellow", "note", message)


def _lacks_memory(error: BaseException) -> bool:
    """Whether Python, numpy or torch could not allocate; torch's CPU allocator says so only in words."""
    return isinstance(error, MemoryError) or "allocate" in str(error) or "out of memory" in str(error).lower()


def _say(color: str, word: str, text: object) -> None:
    from rich.console import Console
    from rich.text import Text

    line = Text.assemble((f"{word}: ", f"bold {color}"), str(text))
    Console(stderr=True, soft_wrap=True, highlight=False).print(line)
