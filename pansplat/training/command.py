"""The `pansplat-train` command."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.training.config import TrainConfig


def run(argv: Sequence[str] | None = None) -> int:
    """Train and return the exit status: 0 done, 2 bad input, 130 stopped and saved."""
    config = parse(argv)
    from pansplat.training.distributed import Processes
    from pansplat.training.loop import Run

    processes = Processes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"pansplat(\.|$)")
        warnings.showwarning = lambda message, *_: _say("note", message)
        try:
            return 0 if Run(config, processes).train() else 130
        except InputError as error:
            _say("error", error)
            return 2
        except KeyboardInterrupt:
            _say("interrupted", "steps after the last checkpoint are lost; the same command goes on from it")
            return 130
        finally:
            processes.leave()


def parse(argv: Sequence[str] | None = None) -> TrainConfig:
    """The settings that the arguments ask for; else prints help or what is wrong with them, and exits."""
    import tyro

    from pansplat.training.presets import PRESETS

    return tyro.extras.overridable_config_cli(
        PRESETS,
        args=argv,
        prog="pansplat-train",
        description="Train a network. A run that was stopped goes on with the same command.",
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _say(word: str, text: object) -> None:
    print(f"{word}: {text}", file=sys.stderr)
