"""`pansplat pose`: camera poses of panoramas, without any other input."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from pansplat.cli.inputs import Computation, OptionalOut
from pansplat.errors import InputError
from pansplat.system.console import make_table_console, print_message, progress_bar
from pansplat.system.files import require_output_file
from pansplat.system.options import CAMERA_HEIGHT, Positive

if TYPE_CHECKING:
    from pansplat.poses.estimate import PoseEstimate


@dataclass(frozen=True)
class Pose(Computation):
    """Estimate the camera poses of equirectangular panoramas of one place."""

    path: Positional[Path]
    """A folder of panoramas, or a web tour."""
    out: OptionalOut = None
    """The poses.json to write. Without it, only the table is shown."""
    camera_height: Positive = CAMERA_HEIGHT
    """Mean height of the cameras over the floor, metres; it sets the scale."""
    baseline: tuple[str, str, float] | None = None
    """Two of the panoramas and their distance in metres, instead of the camera's height."""

    def run(self) -> int:
        """Estimate, print the table and write the file."""
        from pansplat.inputs.folders import load_panoramas
        from pansplat.poses.files import estimate_panoramas, require_mergeable, write_poses

        if self.out is not None:
            require_output_file("--out", self.out, (".json",))
        panoramas = load_panoramas(self.path, posed=False)
        if len(panoramas) < 2:
            raise InputError(f"{self.path}: needed two or more panoramas, got {len(panoramas)}; add the others.")
        if self.out is not None:
            require_mergeable(self.out, [view.image for view in panoramas], overwrite=self.overwrite)
        folder = self.path if self.path.is_dir() else self.path.parent
        with progress_bar():
            estimate = estimate_panoramas(folder, panoramas, camera_height=self.camera_height, baseline=self.baseline)
        _print_estimate(estimate, figures=self.verbose)
        if self.out is not None:
            write_poses(estimate, self.out, overwrite=self.overwrite)
            print(self.out)
        return 0


def _print_estimate(estimate: PoseEstimate, *, figures: bool) -> None:
    """The table of the pairs that place the panoramas, the summary, and the panoramas without a pose."""
    import math

    from rich.table import Table

    table = Table()
    for column in ("pair", "score", "places", "odds", "parallax", "rotation +-", "direction +-", "check"):
        table.add_column(column, justify="left" if column in ("pair", "check") else "right")
    for pair, relation in estimate.relations.items():
        if relation.is_reliable or len(estimate.relations) <= 3:
            problem = relation.problem or ("certain" if relation.is_certain else "probable")
            degrees = [math.degrees(angle) for angle in (relation.parallax, *relation.uncertainty)]
            table.add_row(
                " - ".join(map(estimate.name_of, pair)),
                *(f"{value:.0f}" for value in (relation.score, relation.places)),
                "matches suffice" if math.isinf(relation.log_odds) else f"{math.exp(relation.log_odds):.1f}",
                f"{degrees[0]:.1f}",
                *(f"{value:.2f}" for value in degrees[1:]),
                problem if figures else problem.partition(":")[0],
            )
    make_table_console().print(table)
    print(estimate.summary)
    for image, reason in estimate.apart.items():
        print_message("note", f"{estimate.name_of(image)} is in a smaller group: {reason}")
    for image, reason in estimate.unplaced.items():
        about = " and an approximate place" if image in estimate.approximate else ""
        print_message("note", f"{estimate.name_of(image)} has no pose{about}: {reason}")
    sys.stdout.flush()
