"""Sequences of posed frames (360Loc), and the choice of context and target frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pansplat.errors import InputError
from pansplat.inputs.folder_formats import CAMERA_POSES, read_loc360_sequence
from pansplat.inputs.folders import require_known_masks
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Sample, select_views
from pansplat.system.files import expand_home

Stage = Literal["train", "val"]

LOCATIONS: dict[Stage, tuple[str, ...]] = {
    "train": ("concourse", "hall", "piatrium"),
    "val": ("atrium",),
}
"""Locations of 360Loc by stage (docs/official.md, section 2.2)."""


@dataclass(frozen=True)
class FramePair:
    """Frame numbers of the two context views and of the targets."""

    left: int
    right: int
    targets: tuple[int, ...]


@dataclass(frozen=True)
class BoundedSampler:
    """Chooses two frames with a bounded gap, and targets between them. Source: docs/official.md, section 2.4.

    Attributes:
        min_gap, max_gap: frames from left to right.
        training_gap: "uniform" samples gaps from min_gap to max_gap. "original" always uses min_gap: on paths that are
            not circles the official code replaces max_gap by min_gap.
    """

    min_gap: int = 2
    max_gap: int = 5
    training_gap: Literal["uniform", "original"] = "uniform"

    def training(self, count: int, generator: np.random.Generator) -> FramePair:
        """A random pair of a sequence of `count` frames, and one target from left to right."""
        longest = _longest_gap(count)
        max_gap = min(self.max_gap if self.training_gap == "uniform" else self.min_gap, longest)
        gap = int(generator.integers(min(self.min_gap, max_gap), max_gap, endpoint=True))
        left = int(generator.integers(0, count - gap))
        return FramePair(left, left + gap, (int(generator.integers(left, left + gap, endpoint=True)),))

    def evaluation(self, count: int, draws: int = 100) -> list[FramePair]:
        """`draws` evenly spaced pairs of a sequence of `count` frames; targets are all frames from left to right."""
        gap = min((self.min_gap + self.max_gap) // 2, _longest_gap(count))
        lefts = [(count - gap - 1) * i // max(draws - 1, 1) for i in range(draws)]
        return [FramePair(left, left + gap, tuple(range(left, left + gap + 1))) for left in lefts]


def _longest_gap(count: int) -> int:
    if count < 2:
        raise InputError(f"needed a sequence of two or more posed frames, got {count}; remove it.")
    return count - 1


def read_frame_pair(sequence: PanoramaSet, pair: FramePair, height: int) -> Sample:
    """The sample of a frame pair. Each frame is read once, even if it is both context and target."""
    frames = sorted({pair.left, pair.right, *pair.targets})
    chosen = replace(sequence, targets=tuple(sequence.targets[frame] for frame in frames))
    views, index = chosen.load_targets(height), {frame: i for i, frame in enumerate(frames)}
    return Sample(
        f"{sequence.name}-{pair.left:06d}-{pair.right:06d}",
        select_views(views, [index[pair.left], index[pair.right]]),
        select_views(views, [index[frame] for frame in pair.targets]),
    )


def read_loc360(root: Path | str, stage: Stage) -> list[PanoramaSet]:
    """The 360Loc sequences of a stage's locations, by name: ROOT/{location}/{mapping|query_360}/{*360*}/.

    The frames of a sequence, in order, are the targets of a set. Frames without a mask file show the scene in all
    pixels.
    """
    root = expand_home(root)
    sequences = []
    for location in LOCATIONS[stage]:
        folders = [
            folder
            for part in ("mapping", "query_360")
            for folder in sorted((root / location / part).glob("*360*"))
            if (folder / CAMERA_POSES).is_file()
        ]
        if not folders:
            raise InputError(
                f"{root / location}: needed 360Loc sequences (mapping/*360*/camera_pose.json or the same in query_360) "
                f"for {stage}, got none; download this location, or give the folder that holds "
                f"{', '.join(LOCATIONS[stage])}."
            )
        for folder in folders:
            collection = read_loc360_sequence(folder / CAMERA_POSES, folder)
            require_known_masks(folder, collection.views)
            name, frames = f"{location}-{folder.name}", collection.panoramas
            sequences.append(PanoramaSet(name, folder, (), frames, collection.near, collection.far))
    return sequences
