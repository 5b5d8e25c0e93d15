"""Sources of training and evaluation samples."""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from pansplat.data.layouts import is_matterport3d_scene, read_matterport3d_scene, read_triplet, triplet_files
from pansplat.data.pairs import Pair
from pansplat.data.sequences import BoundedSampler, FramePair, FrameSequence, read_frame_pair
from pansplat.data.views import Sample
from pansplat.errors import InputError


class SampleSource(Protocol):
    """Samples by number."""

    def __len__(self) -> int: ...

    def sample(self, index: int, height: int, seed: int) -> Sample:
        """The sample of that number at (height, 2 height).

        Raises:
            InputError: one of its files cannot be used.
        """
        ...


@dataclass(frozen=True)
class PairSource:
    """Pairs that have targets, each a sample.

    Attributes:
        pairs: read when asked for.
        targets: how many of a pair's targets a sample has, drawn at random; None for all of them.
    """

    pairs: Sequence[Pair]
    targets: int | None = None

    def __post_init__(self) -> None:
        least = self.targets or 1
        for pair in self.pairs:
            _check_targets(pair, least)
        if not self.pairs:
            raise InputError("needed pairs with targets to train on or compare with, got none; see docs/input.md.")

    def __len__(self) -> int:
        return len(self.pairs)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return _read_pair(self.pairs[index], height, self.targets, seed)


@dataclass(frozen=True)
class TripletSource:
    """Triplets on disk, each a sample; `targets` as in `PairSource`."""

    triplets: TripletSet
    targets: int | None = None

    def __len__(self) -> int:
        return len(self.triplets.sources)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        pair = self.triplets.pair(index)
        _check_targets(pair, self.targets or 1)
        return _read_pair(pair, height, self.targets, seed)


@dataclass(frozen=True)
class RandomFramePairs:
    """Random pairs of frames, `draws` from each sequence an epoch."""

    sequences: Sequence[FrameSequence]
    sampler: BoundedSampler
    draws: int = 1000

    def __len__(self) -> int:
        return len(self.sequences) * self.draws

    def sample(self, index: int, height: int, seed: int) -> Sample:
        sequence = self.sequences[index // self.draws]
        draw = self.sampler.training(len(sequence.poses), np.random.default_rng((seed, index)))
        return read_frame_pair(sequence, draw, height)


class FixedFramePairs:
    """Chosen pairs of frames of each sequence, with all their targets.

    Args:
        sequences: posed frames.
        draws: from a number of frames to the pairs of a sequence that long, such as `BoundedSampler().evaluation`.
    """

    def __init__(self, sequences: Sequence[FrameSequence], draws: Callable[[int], Sequence[FramePair]]) -> None:
        self.cases = [(sequence, draw) for sequence in sequences for draw in draws(len(sequence.poses))]

    def __len__(self) -> int:
        return len(self.cases)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return read_frame_pair(*self.cases[index], height)


class ConcatSource:
    """Several sources one after another."""

    def __init__(self, sources: Sequence[SampleSource]) -> None:
        self.sources = [source for source in sources if len(source)]
        self.ends = list(itertools.accumulate(len(source) for source in self.sources))

    def __len__(self) -> int:
        return self.ends[-1] if self.ends else 0

    def sample(self, index: int, height: int, seed: int) -> Sample:
        number = bisect.bisect_right(self.ends, index)
        start = self.ends[number - 1] if number else 0
        return self.sources[number].sample(index - start, height, seed)


def _check_targets(pair: Pair, least: int) -> None:
    if len(pair.targets) < least:
        raise InputError(
            f"{pair.name} in {pair.folder}: needed {least} target panorama(s) to compare with, got "
            f'{len(pair.targets)}; name a "target" in pairs.json or leave the pair out.'
        )


def _read_pair(pair: Pair, height: int, count: int | None, seed: int) -> Sample:
    if count is not None and count < len(pair.targets):
        chosen = np.random.default_rng(seed).choice(len(pair.targets), count, replace=False)
        pair = dataclasses.replace(pair, targets=tuple(pair.targets[i] for i in chosen))
    return Sample(pair.name, pair.load_context(height), pair.load_targets(height))


Stage = Literal["train", "val", "test"]

TRAINING_SETS = (("m3d", 0.5),)
TEST_SETS = (
    ("m3d", 0.1),
    ("m3d", 0.25),
    ("m3d", 0.5),
    ("m3d", 0.75),
    ("m3d", 1.0),
    ("residential", 0.15),
    ("replica", 0.5),
)
"""Name of the scenes' data set, metres from an input to the middle view; the baseline is twice that."""


@dataclass(frozen=True)
class TripletSet:
    """Triplets of one kind.

    Attributes:
        name: such as "m3d_dist_0.5".
        folder: where they are, or would be.
        sources: a scene folder or a .json a triplet, sorted; none where the folder is missing.
    """

    name: str
    folder: Path
    sources: tuple[Path, ...]

    def pair(self, index: int) -> Pair:
        """The triplet of that number as a pair with a target; nothing that travels with the camera is looked for.

        Raises:
            InputError: a file is missing or wrong.
        """
        source = self.sources[index]
        collection = read_triplet(source) if source.is_file() else read_matterport3d_scene(source)
        (pair,) = collection.pairs(source if source.is_dir() else source.parent)
        if not pair.targets:
            raise InputError(f"{source}: needed three views (two inputs and a target between), got two; add one.")
        return dataclasses.replace(pair, siblings=())


def panogrf_folder(root: Path | str, stage: Stage, name: str, distance: float, height: int) -> Path:
    """Where PanoGRF's triplets of that kind are; heights up to 512 read the 1024x512 folder."""
    rows = max(height, 512)
    return Path(root) / f"png_render_{stage}_{2 * rows}x{rows}_seq_len_3_{name}_dist_{distance}"


def read_panogrf(
    root: Path | str, stage: Stage, height: int, sets: Sequence[tuple[str, float]] | None = None
) -> list[TripletSet]:
    """PanoGRF's triplets below a folder, one set a kind; a missing kind is an empty set, and a warning says so.

    Args:
        root: the folder that holds png_render_{stage}_... folders.
        stage: train and val have m3d at 0.5 m only.
        height: of the panoramas wanted, pixels.
        sets: name and distance of each kind; None for all of the stage.

    Raises:
        InputError: none of them is there.
    """
    root = Path(root).expanduser()
    kinds = sets if sets is not None else TEST_SETS if stage == "test" else TRAINING_SETS
    found = []
    for name, distance in kinds:
        folder = panogrf_folder(root, stage, name, distance, height)
        scenes = sorted(folder.iterdir()) if folder.is_dir() else []
        scenes = [scene for scene in scenes if scene.is_dir() and is_matterport3d_scene(scene)]
        found.append(TripletSet(f"{name}_dist_{distance}", folder, tuple(scenes)))
    missing = [str(triplets.folder) for triplets in found if not triplets.sources]
    if len(missing) == len(found):
        raise InputError(
            f"{root}: needed PanoGRF scenes for {stage}, got none in {', '.join(missing)}; give the folder that holds "
            "these, or fetch them."
        )
    if missing:
        warnings.warn(f"no PanoGRF scenes in {', '.join(missing)}; going on without them.", stacklevel=2)
    return found


def read_game_maps(folder: Path | str) -> TripletSet:
    """The triplets NAME.json of a folder.

    Raises:
        InputError: there is none.
    """
    folder = Path(folder).expanduser()
    sources = tuple(triplet_files(folder))
    if not sources:
        raise InputError(
            f"{folder}: needed triplets (NAME.json with NAME_0.png beside it), got none; see docs/input.md."
        )
    return TripletSet(folder.resolve().name, folder, sources)
