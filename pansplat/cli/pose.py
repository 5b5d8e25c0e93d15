"""`pansplat pose`: camera poses of panoramas, or of the key frames of a video, without any other input."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from pansplat.cli.inputs import Computation, OptionalOut
from pansplat.errors import InputError
from pansplat.system.console import make_table_console, print_message, progress_bar
from pansplat.system.files import require_output_file, require_output_folder
from pansplat.system.options import CAMERA_HEIGHT, Count, Positive
from pansplat.system.progress import stage

if TYPE_CHECKING:
    from pansplat.poses.estimate import PoseEstimate


@dataclass(frozen=True)
class Pose(Computation):
    """Estimate the camera poses of equirectangular panoramas of one place."""

    paths: Positional[tuple[Path, ...]]
    """A folder of panoramas, a web tour, or two or more files; or a 360-degree video."""
    out: OptionalOut = None
    """The poses.json to write. Without it, only the table is shown. For a video, a folder for the key frames and their
    poses.json."""
    camera_height: Positive = CAMERA_HEIGHT
    """Mean height of the cameras over the floor, metres; it sets the scale."""
    baseline: tuple[str, str, float] | None = None
    """Two of the files and their distance in metres, instead of the camera's height."""
    frames: Count = 24
    """Largest number of key frames of a video."""

    def run(self) -> int:
        """Estimate, print the table and write the file."""
        from pansplat.inputs.folders import VIDEO_FILES, list_unposed
        from pansplat.poses.files import estimate_panoramas, require_mergeable, write_poses
        from pansplat.poses.key_frames import extract_key_frames

        if not self.paths:
            raise InputError("`pansplat pose` needs a folder of panoramas, a web tour, two or more files, or a video")
        is_video = len(self.paths) == 1 and self.paths[0].suffix.lower() in VIDEO_FILES
        out = self.out
        if is_video:
            if out is None:
                raise InputError("--out must name a folder for the key frames of a video, got none")
            require_output_folder("--out", out)
            out = out / "poses.json"
        elif out is not None:
            require_output_file("--out", out, (".json",))
        panoramas = [] if is_video else list_unposed(self.paths)
        if not is_video and len(panoramas) < 2:
            raise InputError(f"{self.paths[0]}: needed two or more panoramas, got {len(panoramas)}; add the others.")
        if out is not None:
            require_mergeable(out, [view.image for view in panoramas], overwrite=self.overwrite)
        folder = self.paths[0] if self.paths[0].is_dir() else self.paths[0].parent
        with progress_bar():
            if is_video and out is not None:
                folder = out.parent
                with stage(0.5):
                    frames = extract_key_frames(self.paths[0], out.parent, self.frames, overwrite=self.overwrite)
                panoramas = list_unposed(frames)
            estimate = estimate_panoramas(folder, panoramas, camera_height=self.camera_height, baseline=self.baseline)
        _print_estimate(estimate)
        if out is not None:
            write_poses(estimate, out, overwrite=self.overwrite)
            print(out)
        return 0


def _print_estimate(estimate: PoseEstimate) -> None:
    """The table of the pairs that place the panoramas, the summary, and the panoramas without a pose."""
    import math

    from rich.table import Table

    table = Table()
    for column in ("pair", "score", "places", "odds", "parallax", "rotation +-", "direction +-", "check"):
        table.add_column(column, justify="left" if column in ("pair", "check") else "right")
    for (i, j), relation in estimate.relations.items():
        if relation.is_reliable or len(estimate.relations) <= 3:
            degrees = [math.degrees(angle) for angle in (relation.parallax, *relation.uncertainty)]
            table.add_row(
                " - ".join(estimate.name_of(estimate.images[n]) for n in (i, j)),
                *(f"{value:.0f}" for value in (relation.score, relation.places)),
                "matches suffice" if math.isinf(relation.log_odds) else f"{math.exp(relation.log_odds):.1f}",
                f"{degrees[0]:.1f}",
                *(f"{value:.2f}" for value in degrees[1:]),
                relation.problem or ("certain" if relation.is_certain else "probable"),
            )
    make_table_console().print(table)
    print(estimate.summary)
    for image, reason in estimate.probable.items():
        print_message("note", f"{estimate.name_of(image)} is only probably placed, {reason}")
    for image, reason in estimate.apart.items():
        print_message("note", f"{estimate.name_of(image)} is in a smaller group: {reason}")
    for image, reason in estimate.unplaced.items():
        about = " and an approximate place" if image in estimate.approximate else ""
        print_message("note", f"{estimate.name_of(image)} has no pose{about}: {reason}")
    sys.stdout.flush()
