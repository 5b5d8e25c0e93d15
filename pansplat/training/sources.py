"""Sources of samples: anything with a length and `sample(index, height, seed)`.

The same three numbers give the same sample in every process. `seed` determines random choices (frames of a sequence,
one of several targets).
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from pansplat.errors import InputError
from pansplat.inputs.folder_formats import find_panogrf, find_triplets, read_panogrf_scene, read_triplet
from pansplat.inputs.pairs import Pair
from pansplat.inputs.views import Sample
from pansplat.system.files import expand_home
from pansplat.training.sequences import BoundedSampler, FramePair, ImageSequence, Stage, read_frame_pair

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
"""PanoGRF's sets: data set of the scenes, metres from an input to the middle view (the baseline is twice that)."""


class SampleSource(Protocol):
    """Training samples, addressed by their index."""

    def __len__(self) -> int: ...

    def sample(self, index: int, height: int, seed: int) -> Sample:
        """Sample `index` at (height, 2 height)."""
        ...


@dataclass(frozen=True)
class PairSource:
    """Pairs with targets; each is a sample.

    Attributes:
        pairs: files are read by `sample`.
        targets: number of randomly chosen targets per sample; None for all.
    """

    pairs: Sequence[Pair]
    targets: int | None = None

    def __post_init__(self) -> None:
        for pair in self.pairs:
            _check_targets(pair, self.targets or 1)
        if not self.pairs:
            raise InputError("needed pairs with targets for training or evaluation, got none; see docs/input.md.")

    def __len__(self) -> int:
        return len(self.pairs)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return _read_pair(self.pairs[index], height, self.targets, seed)


@dataclass(frozen=True)
class TripletSet:
    """Triplets on disk, in PanoGRF's format or that of game maps.

    Attributes:
        name: such as "m3d_dist_0.5".
        folder: folder of the triplets; may be missing.
        sources: a scene folder or .json file per triplet, sorted; empty if the folder is missing.
    """

    name: str
    folder: Path
    sources: tuple[Path, ...]

    def pair(self, index: int) -> Pair:
        """Triplet `index` as a pair with a target; without detection of static content."""
        source = self.sources[index]
        is_triplet = source.is_file()
        collection = read_triplet(source, source.parent) if is_triplet else read_panogrf_scene(source, source)
        (pair,) = collection.pairs()
        if not pair.targets:
            raise InputError(f"{source}: needed three views (two inputs and a target between), got two; add one.")
        return dataclasses.replace(pair, siblings=())


@dataclass(frozen=True)
class TripletSource:
    """Triplets on disk; each is a sample. `targets` as in `PairSource`."""

    triplets: TripletSet
    targets: int | None = None

    def __len__(self) -> int:
        return len(self.triplets.sources)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        pair = self.triplets.pair(index)
        _check_targets(pair, self.targets or 1)
        return _read_pair(pair, height, self.targets, seed)


def _check_targets(pair: Pair, least: int) -> None:
    if len(pair.targets) < least:
        raise InputError(
            f"{pair.name} in {pair.folder}: needed {least} target panorama(s) for comparison, got "
            f'{len(pair.targets)}; give a "target" in pairs.json or remove the pair.'
        )


def _read_pair(pair: Pair, height: int, count: int | None, seed: int) -> Sample:
    if count is not None and count < len(pair.targets):
        chosen = np.random.default_rng(seed).choice(len(pair.targets), count, replace=False)
        pair = dataclasses.replace(pair, targets=tuple(pair.targets[i] for i in chosen))
    return Sample(pair.name, pair.load_context(height), pair.load_targets(height))


@dataclass(frozen=True)
class RandomFramePairs:
    """Random frame pairs for training; `draws` per sequence make an epoch."""

    sequences: Sequence[ImageSequence]
    sampler: BoundedSampler
    draws: int = 1000

    def __len__(self) -> int:
        return len(self.sequences) * self.draws

    def sample(self, index: int, height: int, seed: int) -> Sample:
        sequence = self.sequences[index // self.draws]
        pair = self.sampler.training(len(sequence.poses), np.random.default_rng((seed, index)))
        return read_frame_pair(sequence, pair, height)


class FixedFramePairs:
    """Fixed frame pairs for evaluation, with all their targets.

    Args:
        sequences: posed frames.
        choose: from a number of frames to frame pairs, such as `BoundedSampler().evaluation`.
    """

    def __init__(self, sequences: Sequence[ImageSequence], choose: Callable[[int], Sequence[FramePair]]) -> None:
        self.pairs = [(sequence, pair) for sequence in sequences for pair in choose(len(sequence.poses))]

    def __len__(self) -> int:
        return len(self.pairs)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return read_frame_pair(*self.pairs[index], height)


class ConcatSource:
    """The samples of several sources, one source after another."""

    def __init__(self, sources: Sequence[SampleSource]) -> None:
        self.sources = [source for source in sources if len(source)]
        self.ends = list(itertools.accumulate(len(source) for source in self.sources))

    def __len__(self) -> int:
        return self.ends[-1] if self.ends else 0

    def sample(self, index: int, height: int, seed: int) -> Sample:
        number = bisect.bisect_right(self.ends, index)
        start = self.ends[number - 1] if number else 0
        return self.sources[number].sample(index - start, height, seed)


def panogrf_folder(root: Path | str, stage: Stage, name: str, distance: float, height: int) -> Path:
    """Folder of one of PanoGRF's sets; heights up to 512 use the 1024x512 images."""
    rows = max(height, 512)
    return Path(root) / f"png_render_{stage}_{2 * rows}x{rows}_seq_len_3_{name}_dist_{distance}"


def read_panogrf(
    root: Path | str, stage: Stage, height: int, sets: Sequence[tuple[str, float]] | None = None
) -> list[TripletSet]:
    """PanoGRF's sets in a folder. A missing set is empty, with a warning. Source: docs/official.md, section 2.1.

    Args:
        root: the folder that holds png_render_{stage}_... folders.
        stage: train and val have m3d at 0.5 m only.
        height: height at which the panoramas will be read, pixels.
        sets: data set and distance of each set; None for all of the stage.
    """
    root = expand_home(root)
    sets = sets if sets is not None else TEST_SETS if stage == "test" else TRAINING_SETS
    found = []
    for name, distance in sets:
        folder = panogrf_folder(root, stage, name, distance, height)
        scenes = sorted(folder.iterdir()) if folder.is_dir() else []
        scenes = [scene for scene in scenes if scene.is_dir() and find_panogrf(scene)]
        found.append(TripletSet(f"{name}_dist_{distance}", folder, tuple(scenes)))
    missing = [str(triplets.folder) for triplets in found if not triplets.sources]
    if len(missing) == len(found):
        raise InputError(
            f"{root}: needed PanoGRF scenes for {stage}, got none in {', '.join(missing)}; give the folder that holds "
            "these, or download them."
        )
    if missing:
        warnings.warn(f"no PanoGRF scenes in {', '.join(missing)}; these sets are skipped.", stacklevel=2)
    return found


def read_game_maps(folder: Path | str) -> TripletSet:
    """The game-map triplets (NAME.json) of a folder."""
    folder = expand_home(folder)
    sources = tuple(find_triplets(folder))
    if not sources:
        raise InputError(
            f"{folder}: needed triplets (NAME.json with NAME_0.png next to it), got none; see docs/input.md."
        )
    return TripletSet(folder.resolve().name, folder, sources)
