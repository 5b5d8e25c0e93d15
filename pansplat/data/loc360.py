"""The 360Loc data set: halls filmed with a 360-degree camera.

Source: OFFICIAL.md 2.2. ROOT/{location}/{mapping|query_360}/{*360*}/camera_pose.json with image/ beside it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pansplat.data.frames import PictureSequence
from pansplat.data.sequences import is_loc360_sequence, read_loc360_sequence
from pansplat.errors import InputError

Stage = Literal["train", "val", "test"]

LOCATIONS: dict[str, tuple[str, ...]] = {
    "train": ("concourse", "hall", "piatrium"),
    "val": ("atrium",),
    "test": ("atrium",),
}


def read_loc360(root: Path | str, stage: Stage) -> list[PictureSequence]:
    """All sequences of the stage's locations, by name; pictures are read when asked for.

    Raises:
        InputError: a location is missing or has no sequence, or a camera_pose.json is wrong.
    """
    root = Path(root).expanduser()
    sequences = []
    for location in LOCATIONS[stage]:
        folders = [
            folder
            for part in ("mapping", "query_360")
            for folder in sorted((root / location / part).glob("*360*"))
            if is_loc360_sequence(folder)
        ]
        if not folders:
            raise InputError(
                f"{root / location}: needed 360Loc sequences (mapping/*360*/camera_pose.json or the same in query_360) "
                f"for {stage}, got none; fetch this location, or give the folder that holds "
                f"{', '.join(LOCATIONS[stage])}."
            )
        for folder in folders:
            collection = read_loc360_sequence(folder)
            sequences.append(
                PictureSequence(f"{location}-{folder.name}", collection.panoramas, collection.near, collection.far)
            )
    return sequences
