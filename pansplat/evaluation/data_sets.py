"""The paper's test sets, as far as they are on this machine.

Source: PanSplat, section 4; OFFICIAL.md, sections 2.1 to 2.5 and 13. A set is named as the paper's tables name it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pansplat.data.frames import FrameSequence, read_draw
from pansplat.data.insta360 import read_insta360
from pansplat.data.loc360 import read_loc360
from pansplat.data.sample import Sample
from pansplat.data.samplers import BoundedSampler, Draw
from pansplat.data.triplets import TripletSet, panogrf_folder, read_panogrf
from pansplat.errors import InputError

LOC360, INSTA360 = "360Loc", "Insta360"

_INSIDE = {  # where a data set may lie in the folder that is given
    "panogrf": (".", "pano_grf", "datasets/pano_grf"),
    LOC360: (".", "360Loc", "datasets/360Loc"),
    INSTA360: (".", "insta360", "datasets/insta360"),
}
_SAMPLERS = {LOC360: BoundedSampler(2, 5), INSTA360: BoundedSampler(2, 30)}


@dataclass(frozen=True)
class EvaluationCase:
    """One scene of a set: `read(height)` gives its inputs and targets."""

    name: str
    read: Callable[[int], Sample]


@dataclass(frozen=True)
class EvaluationSet:
    """A test set.

    Attributes:
        name: as the paper's tables have it, such as "M3D 1.0 m".
        cases: empty where the data is missing.
        missing: what would have been needed, naming the folder; empty where it is here.
    """

    name: str
    cases: tuple[EvaluationCase, ...] = ()
    missing: str = ""


def panogrf_set(root: Path, title: str, name: str, distance: float, height: int) -> EvaluationSet:
    """Triplets of one kind and one distance (metres) from an input to the middle view."""
    for inside in _INSIDE["panogrf"]:
        try:
            (triplets,) = read_panogrf(root / inside, "test", height, [(name, distance)])
        except InputError:
            continue
        cases = [
            EvaluationCase(source.name, functools.partial(_read_triplet, triplets, index))
            for index, source in enumerate(triplets.sources)
        ]
        return EvaluationSet(title, tuple(cases))
    wanted = panogrf_folder(root / "pano_grf", "test", name, distance, height)
    return EvaluationSet(title, missing=f"{title}: needed PanoGRF's scenes in {wanted} (or in {root / wanted.name})")


def _read_triplet(triplets: TripletSet, index: int, height: int) -> Sample:
    pair = triplets.pair(index)
    return Sample(pair.name, pair.load_context(height), pair.load_targets(height))


def sequence_set(root: Path, name: str, draws: int = 100) -> EvaluationSet:
    """`LOC360` or `INSTA360`: pairs spread evenly over each sequence, all frames between and at them as targets."""
    sequences, missing = sequences_of(root, name)
    return EvaluationSet(name, tuple(_cases(sequences, _SAMPLERS[name], draws)), missing)


def frame_distance_set(sequences: Sequence[FrameSequence], gap: int, draws: int) -> EvaluationSet:
    """Pairs of frames `gap` apart, spread evenly over each sequence, with the frame in the middle as target."""
    long = [sequence for sequence in sequences if len(sequence.poses) > gap]
    cases = tuple(_cases(long, BoundedSampler(gap, gap), draws, middle=True))
    missing = "" if cases else f"{gap} frames apart: needed a sequence of more than {gap} frames"
    return EvaluationSet(f"{gap} frames", cases, missing)


def sequences_of(root: Path, name: str) -> tuple[Sequence[FrameSequence], str]:
    """The sequences of `LOC360` (its test location) or `INSTA360`, and what is missing when there are none.

    Raises:
        InputError: when the data is there and wrong.
    """
    for inside in _INSIDE[name]:
        folder = root / inside
        if name == LOC360 and (folder / "atrium").is_dir():
            return read_loc360(folder, "test"), ""
        if name == INSTA360 and _has_videos(folder):
            return read_insta360(folder), ""
    if name == LOC360:
        return [], f"{name}: needed {root / '360Loc' / 'atrium'} (mapping/*360*/camera_pose.json with image/ beside it)"
    return [], f"{name}: needed {root / 'insta360' / 'VID_*'} (video.mp4 with frame_trajectory.txt beside it)"


def _has_videos(folder: Path) -> bool:
    return any(folder.glob("*.mp4")) or any(folder.glob("*/*.mp4"))


def _cases(
    sequences: Sequence[FrameSequence], sampler: BoundedSampler, draws: int, *, middle: bool = False
) -> list[EvaluationCase]:
    cases = []
    for sequence in sequences:
        for draw in sampler.evaluation(len(sequence.poses), draws):
            if middle:
                draw = Draw(draw.left, draw.right, (draw.targets[len(draw.targets) // 2],))
            name = f"{sequence.name}-{draw.left:06d}-{draw.right:06d}"
            cases.append(EvaluationCase(name, functools.partial(read_draw, sequence, draw)))
    return cases
