"""`pansplat data`: training data of the depth network."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, subcommand

from pansplat.cli.inputs import Out
from pansplat.files import require_output_folder
from pansplat.options import WHOLE, Count, Range, Seed, Threads

_Height = Annotated[int, Range(32, 8192, "pixels", multiple=32), WHOLE]


@dataclass(frozen=True)
class DataHomes:
    """Render tours of generated homes into compressed shards. The same seed always gives the same tours."""

    out: Out
    """Folder for the shards. Shards that are there are kept; run the command again after an interruption."""
    count: Count = 1024
    """Number of homes, rounded up to whole shards of 16."""
    seed: Seed = 0
    """Seed of the homes."""
    height: _Height = 128
    """Height of the panoramas, pixels; a multiple of 32."""
    cameras: Annotated[int, Range(2, 1000), WHOLE] = 4
    """Panoramas of each home."""
    furniture: Path | None = None
    """Folder with furniture catalogues (*.sh3f) of the Debian package sweethome3d-furniture; by default only our own
    furniture is placed."""
    workers: Threads = 1
    """Processes that render."""

    def run(self) -> int:
        """Render with a progress bar."""
        from rich.progress import Progress

        from pansplat.data.generated.shards import TourSettings, write_shards

        require_output_folder("--out", self.out)
        settings = TourSettings(seed=self.seed, height=self.height, cameras=self.cameras, furniture=self.furniture)
        with Progress() as progress:
            task = progress.add_task("rendering homes", total=self.count)

            def advance(tours: int) -> None:
                progress.advance(task, tours)

            shards = write_shards(self.out, self.count, settings, workers=self.workers, progress=advance)
        print(f"{self.out}: {shards} new shards")
        return 0


@dataclass(frozen=True)
class DataPhotographs:
    """Render generated homes as folders of photographs with poses, one or two a room, to measure `pansplat pose`."""

    out: Out
    """Folder for the homes. Homes that are there are kept; run the command again after an interruption."""
    count: Count = 20
    """Number of homes."""
    seed: Seed = 0
    """Seed of the homes."""
    height: Annotated[int, Range(256, 8192, "pixels", multiple=32), WHOLE] = 1024
    """Height of the panoramas, pixels."""
    furniture: Path | None = None
    """As for `homes`."""

    def run(self) -> int:
        """Render with a progress bar, and print the number of photographs."""
        from rich.progress import track

        from pansplat.data.generated.photographs import write_home
        from pansplat.data.generated.shards import load_library

        require_output_folder("--out", self.out)
        library = None if self.furniture is None else load_library(self.furniture)
        photographs = 0
        for number in track(range(self.count), "rendering homes"):
            photographs += write_home(self.out / f"home_{number:03d}", (self.seed, number), self.height, library)
        print(f"{self.out}: {photographs} photographs of {self.count} homes")
        return 0


@dataclass(frozen=True)
class DataFlights:
    """Render flights through generated homes, with targets on the way, for `pansplat bench flights`."""

    out: Out
    """Folder for the flights. Flights that are there are kept; run the command again after an interruption."""
    count: Count = 12
    """Number of flights."""
    seed: Seed = 5200
    """Seed of the homes."""
    height: Annotated[int, Range(64, 8192, "pixels", multiple=32), WHOLE] = 512
    """Height of the panoramas, pixels."""

    def run(self) -> int:
        """Render with a progress bar, and print the mean length."""
        from rich.progress import track

        from pansplat.data.generated.flights import write_flight

        require_output_folder("--out", self.out)
        lengths = [
            write_flight(self.out / f"flight_{number:02d}", (self.seed, number), self.height)
            for number in track(range(self.count), "rendering flights")
        ]
        print(f"{self.out}: {self.count} flights of {sum(lengths) / self.count:.1f} m in the mean")
        return 0


@dataclass(frozen=True)
class DataMaps:
    """Pack triplets that were rendered from game maps (PNG, depth in millimetres, JSON) into shards."""

    source: Positional[Path]
    """Folder of the triplets."""
    out: Out
    """Folder for the shards."""
    height: Annotated[int, Range(32, 8192, "pixels"), WHOLE] = 128
    """Height of the panoramas, pixels."""

    def run(self) -> int:
        """Pack and print the number of tours."""
        from pansplat.data.generated.shards import pack_triplets

        require_output_folder("--out", self.out)
        print(f"{self.out}: {pack_triplets(self.source, self.out, self.height)} tours")
        return 0


@dataclass(frozen=True)
class Data:
    """Make training data of the depth network, and photographs with known poses."""

    kind: (
        Annotated[DataHomes, subcommand("homes")]
        | Annotated[DataPhotographs, subcommand("photographs")]
        | Annotated[DataFlights, subcommand("flights")]
        | Annotated[DataMaps, subcommand("maps")]
    )

    def run(self) -> int:
        """Run the subcommand."""
        return self.kind.run()
