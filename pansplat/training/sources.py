"""Sources of samples: anything with a length and `sample(index, height, seed)`.

The same three numbers give the same sample in every process. `seed` determines random choices (frames of a sequence,
one of several targets).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from pansplat.errors import InputError
from pansplat.inputs.folder_formats import find_panogrf, find_triplets, read_panogrf_scene, read_triplet
from pansplat.inputs.folders import load_sets
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Sample
from pansplat.system.files import expand_home
from pansplat.training.config import DataConfig
from pansplat.training.room import RoomTriplets
from pansplat.training.sequences import BoundedSampler, FramePair, Stage, read_frame_pair, read_loc360

_VALIDATION_SEED_OFFSET = 1_000_003  # added to the seed, so that rooms differ from those of training
_VALIDATION_DRAWS = 4  # frame pairs per sequence


class SampleSource(Protocol):
    """Training samples, addressed by their index."""

    def __len__(self) -> int: ...

    def sample(self, index: int, height: int, seed: int) -> Sample:
        """Sample `index` at (height, 2 height)."""
        ...


@dataclass(frozen=True)
class PairSource:
    """Pairs with targets; each is a sample. Files are read by `sample`."""

    pairs: Sequence[PanoramaSet]

    def __post_init__(self) -> None:
        if not self.pairs:
            raise InputError("needed pairs with targets for training, got none; see docs/input.md.")

    def __len__(self) -> int:
        return len(self.pairs)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return _read_pair(self.pairs[index], height, seed)


@dataclass(frozen=True)
class TripletSource:
    """Triplets on disk, in PanoGRF's format or that of game maps; each is a sample.

    Attributes:
        sources: a scene folder or .json file per triplet.
    """

    sources: tuple[Path, ...]

    def __len__(self) -> int:
        return len(self.sources)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        source = self.sources[index]
        is_triplet = source.is_file()
        collection = read_triplet(source, source.parent) if is_triplet else read_panogrf_scene(source, source)
        (pair,) = collection.sets()
        if not pair.targets:
            raise InputError(f"{source}: needed three views (two inputs and a target between), got two; add one.")
        return _read_pair(dataclasses.replace(pair, siblings=()), height, seed)  # without detection of static content


def _read_pair(pair: PanoramaSet, height: int, seed: int) -> Sample:
    """The sample of a pair with one of its targets."""
    target = pair.targets[np.random.default_rng(seed).integers(len(pair.targets))]
    return Sample(
        pair.name, pair.load_context(height), dataclasses.replace(pair, targets=(target,)).load_targets(height)
    )


@dataclass(frozen=True)
class RandomFramePairs:
    """Random frame pairs for training; `draws` per sequence make an epoch."""

    sequences: Sequence[PanoramaSet]
    sampler: BoundedSampler
    draws: int = 1000

    def __len__(self) -> int:
        return len(self.sequences) * self.draws

    def sample(self, index: int, height: int, seed: int) -> Sample:
        sequence = self.sequences[index // self.draws]
        pair = self.sampler.training(len(sequence.targets), np.random.default_rng((seed, index)))
        return read_frame_pair(sequence, pair, height)


class FixedFramePairs:
    """Fixed frame pairs for evaluation, with all their targets.

    Args:
        sequences: posed frames.
        choose: from a number of frames to frame pairs, such as `BoundedSampler().evaluation`.
    """

    def __init__(self, sequences: Sequence[PanoramaSet], choose: Callable[[int], Sequence[FramePair]]) -> None:
        self.pairs = [(sequence, pair) for sequence in sequences for pair in choose(len(sequence.targets))]

    def __len__(self) -> int:
        return len(self.pairs)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return read_frame_pair(*self.pairs[index], height)


def read_panogrf(root: Path | str, stage: Stage, height: int) -> TripletSource:
    """PanoGRF's triplets of Matterport3D, 0.5 m between views. Source: docs/official.md, section 2.1.

    Args:
        root: the folder that holds png_render_{stage}_... folders.
        stage: train or val.
        height: height at which the panoramas will be read, pixels; up to 512 the 1024x512 images are read.
    """
    rows = max(height, 512)
    folder = expand_home(root) / f"png_render_{stage}_{2 * rows}x{rows}_seq_len_3_m3d_dist_0.5"
    scenes = sorted(folder.iterdir()) if folder.is_dir() else []
    scenes = [scene for scene in scenes if scene.is_dir() and find_panogrf(scene)]
    if not scenes:
        raise InputError(
            f"{root}: needed PanoGRF scenes for {stage}, got none in {folder}; give the folder that holds it, or "
            "download it."
        )
    return TripletSource(tuple(scenes))


def read_game_maps(folder: Path | str) -> TripletSource:
    """The game-map triplets (NAME.json) of a folder."""
    folder = expand_home(folder)
    sources = tuple(find_triplets(folder))
    if not sources:
        raise InputError(
            f"{folder}: needed triplets (NAME.json with NAME_0.png next to it), got none; see docs/input.md."
        )
    return TripletSource(sources)


def load_sources(config: DataConfig, height: int, seed: int) -> tuple[SampleSource, SampleSource]:
    """Training samples, and validation samples, which have at least one target.

    Args:
        height: height of the panoramas; selects the folder of some data sets.
    """
    if config.kind == "room":
        return RoomTriplets(seed), RoomTriplets(seed + _VALIDATION_SEED_OFFSET)
    root = config.root
    assert root is not None
    if config.kind == "panogrf":
        return read_panogrf(root, "train", height), read_panogrf(root, "val", height)
    if config.kind in ("pairs", "triplets"):
        read = _read_pairs if config.kind == "pairs" else read_game_maps
        return read(root), read(config.validation_root or root)
    sampler = BoundedSampler(training_gap=config.training_gap)
    training = RandomFramePairs(read_loc360(root, "train"), sampler, config.draws)
    unseen = read_loc360(root, "val")
    return training, FixedFramePairs(unseen, lambda count: sampler.evaluation(count, _VALIDATION_DRAWS))


def _read_pairs(folder: Path) -> PairSource:
    return PairSource([pair for pair in load_sets(folder) if pair.targets])
