"""The `pansplat-homes` command. `python -m pansplat_homes` runs it too."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

from msgspec import Meta
from tyro.conf import Positional, subcommand

from pansplat.cli.inputs import Out
from pansplat.system.console import own_warnings, parse_arguments, run_command
from pansplat.system.files import require_output_folder
from pansplat.system.options import Count, Seed, Threads, check_numbers
from pansplat_homes.depth import DepthTrainConfig
from pansplat_homes.matcher import ConvertMatcher
from pansplat_homes.sharpening import SharpeningTrainConfig

_T = TypeVar("_T")


@dataclass(frozen=True)
class Homes:
    """Render tours of generated homes into compressed shards. The same seed always gives the same tours."""

    out: Out
    """Folder for the shards. Shards that are there are kept; run the command again after an interruption."""
    count: Count = 1024
    """Number of homes, rounded up to whole shards of 16."""
    seed: Seed = 0
    """Seed of the homes."""
    height: Annotated[int, Meta(ge=32, le=8192, multiple_of=32)] = 128
    """Height of the panoramas, pixels; a multiple of 32."""
    cameras: Annotated[int, Meta(ge=2, le=1000)] = 4
    """Panoramas of each home."""
    furniture: Path | None = None
    """Folder with furniture catalogues (*.sh3f) of the Debian package sweethome3d-furniture; by default only our own
    furniture is placed."""
    workers: Threads = 1
    """Processes that render."""

    def run(self) -> int:
        """Render with a progress bar."""
        from rich.progress import Progress

        from pansplat_homes.shards import TourSettings, write_shards

        require_output_folder("--out", self.out)
        settings = TourSettings(seed=self.seed, height=self.height, cameras=self.cameras, furniture=self.furniture)
        with Progress() as progress:
            task = progress.add_task("rendering homes", total=self.count)

            def advance(tours: int) -> None:
                progress.advance(task, tours)

            shards = write_shards(self.out, self.count, settings, workers=self.workers, progress=advance)
        print(f"{self.out}: {shards} new shards")
        return 0


def _render_each(out: Path, count: int, what: str, write: Callable[[int], _T]) -> list[_T]:
    """The results of `write` for the numbers 0 to `count` - 1, with a progress bar."""
    from rich.progress import track

    require_output_folder("--out", out)
    return [write(number) for number in track(range(count), f"rendering {what}")]


@dataclass(frozen=True)
class Photographs:
    """Render generated homes as folders of photographs with poses, one or two a room, to measure `pansplat pose`."""

    out: Out
    """Folder for the homes. Homes that are there are kept; run the command again after an interruption."""
    count: Count = 20
    """Number of homes."""
    seed: Seed = 0
    """Seed of the homes."""
    height: Annotated[int, Meta(ge=256, le=8192, multiple_of=32)] = 1024
    """Height of the panoramas, pixels."""
    furniture: Path | None = None
    """As for `homes`."""

    def run(self) -> int:
        """Render, and print the number of photographs."""
        from pansplat_homes.photographs import write_home
        from pansplat_homes.shards import load_library

        def write(number: int) -> int:
            library = None if self.furniture is None else load_library(self.furniture)
            return write_home(self.out / f"home_{number:03d}", (self.seed, number), self.height, library)

        photographs = sum(_render_each(self.out, self.count, "homes", write))
        print(f"{self.out}: {photographs} photographs of {self.count} homes")
        return 0


@dataclass(frozen=True)
class Flights:
    """Render flights through generated homes, with targets on the way, for `pansplat evaluate`."""

    out: Out
    """Folder for the flights. Flights that are there are kept; run the command again after an interruption."""
    count: Count = 12
    """Number of flights."""
    seed: Seed = 5200
    """Seed of the homes."""
    height: Annotated[int, Meta(ge=64, le=8192, multiple_of=32)] = 512
    """Height of the panoramas, pixels."""

    def run(self) -> int:
        """Render, and print the mean length."""
        from pansplat_homes.flights import write_flight

        def write(number: int) -> float:
            return write_flight(self.out / f"flight_{number:02d}", (self.seed, number), self.height)

        lengths = _render_each(self.out, self.count, "flights", write)
        print(f"{self.out}: {self.count} flights of {sum(lengths) / self.count:.1f} m in the mean")
        return 0


@dataclass(frozen=True)
class Triplets:
    """Render triplets of panoramas of generated homes with depth, for `pansplat-train small --data.root FOLDER`."""

    out: Out
    """Folder for the triplets. Triplets that are there are kept; run the command again after an interruption."""
    count: Count = 1000
    """Number of triplets, each in a home of its own."""
    seed: Seed = 0
    """Seed of the homes."""
    height: Annotated[int, Meta(ge=64, le=8192, multiple_of=32)] = 256
    """Height of the panoramas, pixels."""

    def run(self) -> int:
        """Render, and print the number of triplets."""
        from pansplat_homes.triplets import write_triplet

        _render_each(self.out, self.count, "triplets", lambda n: write_triplet(self.out, self.seed, n, self.height))
        print(f"{self.out}: {self.count} triplets")
        return 0


@dataclass(frozen=True)
class Maps:
    """Pack triplets that were rendered from game maps (PNG, depth in millimetres, JSON) into shards."""

    source: Positional[Path]
    """Folder of the triplets."""
    out: Out
    """Folder for the shards."""
    height: Annotated[int, Meta(ge=32, le=8192)] = 128
    """Height of the panoramas, pixels."""

    def run(self) -> int:
        """Pack and print the number of tours."""
        from pansplat_homes.shards import pack_triplets

        require_output_folder("--out", self.out)
        print(f"{self.out}: {pack_triplets(self.source, self.out, self.height)} tours")
        return 0


Command = (
    Annotated[Homes, subcommand("homes")]
    | Annotated[Photographs, subcommand("photographs")]
    | Annotated[Flights, subcommand("flights")]
    | Annotated[Triplets, subcommand("triplets")]
    | Annotated[Maps, subcommand("maps")]
    | Annotated[DepthTrainConfig, subcommand("train-depth")]
    | Annotated[SharpeningTrainConfig, subcommand("train-sharpening")]
    | Annotated[ConvertMatcher, subcommand("convert-matcher")]
)


def run(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status; help and misspelt arguments raise SystemExit."""

    def run_parsed() -> int:
        import tyro

        command = parse_arguments(
            lambda args: tyro.cli(
                Command,  # pyright: ignore[reportArgumentType]
                args=args,
                prog="pansplat-homes",
                description="Make the data and the weights that pansplat ships.",
            ),
            "pansplat-homes",
            argv,
        )
        check_numbers(command)
        with own_warnings():
            return command.run()

    return run_command(
        run_parsed,
        memory_advice="choose a smaller --height, or fewer --pairs.",
        interruption="no incomplete file is left behind; run the command again to continue",
    )


def main() -> None:
    """Run the command line and exit."""
    sys.exit(run())


if __name__ == "__main__":
    main()
