"""The `pansplat-train` command; `python -m pansplat.training` runs it too."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from pansplat.system.console import own_warnings, parse_arguments, run_command

if TYPE_CHECKING:
    from pansplat.training.config import TrainConfig


def run(argv: Sequence[str] | None = None) -> int:
    """Train and return the exit status: 0 done, 2 invalid input, 130 or 143 stopped by a signal and saved."""
    return run_command(
        lambda: _train(parse(argv)),
        memory_advice="choose lower --heights, a smaller --optimizer.batch-size, or --memory.backpropagation two-step "
        "with more --memory.tiles.",
        interruption="steps after the last checkpoint are lost; run the same command to resume from it",
    )


def _train(config: TrainConfig) -> int:
    from pansplat.system.files import require_output_folder
    from pansplat.training.trainer import Trainer

    config.check()
    require_output_folder("--out", config.out)
    with own_warnings():
        trainer = Trainer(config)
        return 0 if trainer.train() else trainer.stop.status


def parse(argv: Sequence[str] | None = None) -> TrainConfig:
    """The settings of a command line. Prints help or errors and exits like argparse."""

    def read(arguments: Sequence[str]) -> TrainConfig:
        import tyro

        from pansplat.training.config import PRESETS

        return tyro.extras.overridable_config_cli(
            PRESETS,
            args=arguments,
            prog="pansplat-train",
            description="Train a network. Run the same command again to resume a stopped run.",
            config=(tyro.conf.FlagCreatePairsOff,),
        )

    return parse_arguments(read, "pansplat-train", argv)


def main() -> NoReturn:
    """The entry point: `run`, then the end of this process."""
    sys.exit(run())


if __name__ == "__main__":
    main()
