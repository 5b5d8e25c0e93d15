"""Training and validation data of a run, without the game maps that are reserved for evaluation."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pansplat.errors import InputError
from pansplat.inputs.folders import load_pairs
from pansplat.training.config import DataConfig
from pansplat.training.room import RoomTriplets
from pansplat.training.sequences import BoundedSampler, read_loc360
from pansplat.training.sources import (
    ConcatSource,
    FixedFramePairs,
    PairSource,
    RandomFramePairs,
    SampleSource,
    TripletSource,
    read_game_maps,
    read_panogrf,
)

_T = TypeVar("_T")

RESERVED = frozenset(
    {
        *("oa_minia", "oa_koth1", "mictf1beta", "hydronex", "hydronex2", "sleekgrinder", "pul1duel-oa", "oacmpdm1"),
        *("oa_shouse", "strength", "bleach"),
    }
)
"""Game maps for evaluation only; their triplets are named NAME_NUMBER. Maps that share rooms are reserved together."""

_NUMBER = re.compile(r"(_\d+)+$")
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
        training, validation = (
            ConcatSource([TripletSource(triplets) for triplets in read_panogrf(root, stage, height)])
            for stage in ("train", "val")
        )
        return training, validation
    if config.kind in ("pairs", "triplets"):
        read = _read_pairs if config.kind == "pairs" else _read_triplets
        return read(root), read(config.validation_root or root)
    sampler = BoundedSampler(training_gap=config.training_gap)
    training = RandomFramePairs(read_loc360(root, "train"), sampler, config.draws)
    unseen = read_loc360(root, "val")
    return training, FixedFramePairs(unseen, lambda count: sampler.evaluation(count, _VALIDATION_DRAWS))


def _read_pairs(folder: Path) -> PairSource:
    pairs = [pair for pair in load_pairs(folder) if pair.targets]
    return PairSource(remove_reserved(pairs, lambda pair: pair.name, folder), targets=1)


def _read_triplets(folder: Path) -> TripletSource:
    triplets = read_game_maps(folder)
    kept = remove_reserved(triplets.sources, lambda source: source.stem, folder)
    return TripletSource(replace(triplets, sources=tuple(kept)))


def is_reserved(name: str) -> bool:
    """Whether a triplet of that name belongs to a reserved map."""
    return name.lower() in RESERVED or _NUMBER.sub("", name.lower()) in RESERVED


def remove_reserved(items: Iterable[_T], name_of: Callable[[_T], str], folder: Path) -> list[_T]:
    """The items of maps that are not reserved, with a warning if some are; an InputError if all are."""
    items = list(items)
    kept = [item for item in items if not is_reserved(name_of(item))]
    if items and not kept:
        raise InputError(
            f"{folder}: needed training data, got {len(items)} triplets of reserved maps only "
            f"({', '.join(sorted(RESERVED))}), which are for evaluation; use other maps."
        )
    if len(kept) < len(items):
        warnings.warn(
            f"{folder}: {len(items) - len(kept)} of {len(items)} triplets belong to maps that are reserved for "
            "evaluation, and are skipped.",
            stacklevel=3,
        )
    return kept
