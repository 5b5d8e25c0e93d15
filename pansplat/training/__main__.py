"""The `pansplat-train` command; also `python -m pansplat.training`, as torchrun starts it."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from pansplat.errors import InputError

if TYPE_CHECKING:
    from pansplat.training.config import TrainConfig


def run(argv: Sequence[str] | None = None) -> int:
    """Train and return the exit status: 0 done, 2 bad input, 130 stopped and saved."""
    try:
        return _train(parse(argv))
    except InputError as error:
        _say("error", error)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not _lacks_memory(error):
            raise
        _say(
            "error",
            f"this takes more memory than there is ({str(error).splitlines()[0][:120]}); choose lower --heights, a "
            "smaller --optimizer.batch-size, or --memory.backpropagation two-step with more --memory.tiles.",
        )
        return 2
    except KeyboardInterrupt:
        _say("interrupted", "steps after the last checkpoint are lost; the same command goes on from it")
        return 130


def _train(config: TrainConfig) -> int:
    from pansplat.training.distributed import ProcessGroup
    from pansplat.training.trainer import Trainer

    processes = ProcessGroup()
    with _our_warnings():
        try:
            return 0 if Trainer(config, processes).train() else 130
        finally:
            processes.leave()


@contextlib.contextmanager
def _our_warnings() -> Iterator[None]:
    """What the libraries below warn of is for their users; what we warn of is for ours."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("always", category=UserWarning, module=r"pansplat(\.|$)")
        warnings.showwarning = lambda message, *_: _say("note", message)
        yield


def parse(argv: Sequence[str] | None = None) -> TrainConfig:
    """The settings that the arguments ask for; else prints help or what is wrong with them, and exits."""
    import tyro

    from pansplat.training.config import PRESETS

    return tyro.extras.overridable_config_cli(
        PRESETS,
        args=argv,
        prog="pansplat-train",
        description="Train a network. A run that was stopped goes on with the same command.",
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _lacks_memory(error: BaseException) -> bool:
    """Whether Python, numpy or torch could not allocate; torch's CPU allocator says so only in words."""
    return isinstance(error, MemoryError) or "allocate" in str(error) or "out of memory" in str(error).lower()


def _say(word: str, text: object) -> None:
    print(f"{word}: {text}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(run())
