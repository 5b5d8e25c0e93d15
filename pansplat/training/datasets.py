"""Training and validation data of a run."""

from __future__ import annotations

from pathlib import Path

from pansplat.inputs.folders import load_pairs
from pansplat.training.config import DataConfig
from pansplat.training.room import RoomTriplets
from pansplat.training.sequences import BoundedSampler, read_loc360
from pansplat.training.sources import (
    FixedFramePairs,
    PairSource,
    RandomFramePairs,
    SampleSource,
    read_game_maps,
    read_panogrf,
)

_VALIDATION_SEED_OFFSET = 1_000_003  # rooms differ from those of training
_VALIDATION_DRAWS = 4  # frame pairs per sequence


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
    return PairSource([pair for pair in load_pairs(folder) if pair.targets])
