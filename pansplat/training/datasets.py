"""Training and validation data of a run."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pansplat.data.generated.triplets import GeneratedTriplets
from pansplat.data.layouts import load_pairs
from pansplat.data.sequences import BoundedSampler, read_insta360, read_loc360
from pansplat.data.sources import (
    ConcatSource,
    FixedFramePairs,
    PairSource,
    RandomFramePairs,
    SampleSource,
    TripletSource,
    read_game_maps,
    read_panogrf,
)
from pansplat.errors import InputError
from pansplat.training.config import DataConfig

_OTHER_HOMES = 1_000_003  # apart from the seeds of training
_FEW_DRAWS = 4  # pairs of each sequence to compare with


def sources(config: DataConfig, height: int, seed: int) -> tuple[SampleSource, SampleSource]:
    """What is trained on, and what is compared with on the way; the latter has one target a sample.

    Triplets of maps that are reserved for evaluation are in neither.

    Args:
        height: of the panoramas, which decides on the folder of some data sets.

    Raises:
        InputError: the data are not there, or wrong.
    """
    if config.kind == "generated":
        return GeneratedTriplets(seed), GeneratedTriplets(seed + _OTHER_HOMES)
    assert config.root is not None
    return _READERS[config.kind](config, config.root, height)


def _panogrf(config: DataConfig, root: Path, height: int) -> tuple[SampleSource, SampleSource]:
    training, validation = (read_panogrf(root, stage, height) for stage in ("train", "val"))
    return ConcatSource([TripletSource(t) for t in training]), ConcatSource([TripletSource(t) for t in validation])


def _loc360(config: DataConfig, root: Path, height: int) -> tuple[SampleSource, SampleSource]:
    sampler = BoundedSampler(2, 5, config.training_gap)
    training = RandomFramePairs(read_loc360(root, "train"), sampler, config.draws)
    return training, FixedFramePairs(read_loc360(root, "val"), lambda n: sampler.evaluation(n, _FEW_DRAWS))


def _insta360(config: DataConfig, root: Path, height: int) -> tuple[SampleSource, SampleSource]:
    sampler = BoundedSampler(2, 30, config.training_gap)
    films = read_insta360(root)
    validation = films if config.validation_root is None else read_insta360(config.validation_root)
    return (
        RandomFramePairs(films, sampler, config.draws),
        FixedFramePairs(validation, lambda n: sampler.evaluation(n, _FEW_DRAWS)),
    )


def _pairs(config: DataConfig, root: Path, height: int) -> tuple[SampleSource, SampleSource]:
    training, validation = (_pairs_of(folder) for folder in (root, config.validation_root or root))
    return training, validation


def _pairs_of(folder: Path) -> PairSource:
    pairs = [pair for pair in load_pairs(folder) if pair.targets]
    return PairSource(without_reserved(pairs, lambda pair: pair.name, folder), targets=1)


def _triplets(config: DataConfig, root: Path, height: int) -> tuple[SampleSource, SampleSource]:
    training, validation = (_game_maps(folder) for folder in (root, config.validation_root or root))
    return training, validation


def _game_maps(folder: Path) -> TripletSource:
    triplets = read_game_maps(folder)
    kept = without_reserved(triplets.sources, lambda source: source.stem, folder)
    return TripletSource(replace(triplets, sources=tuple(kept)))


_READERS: dict[str, Callable[[DataConfig, Path, int], tuple[SampleSource, SampleSource]]] = {
    "panogrf": _panogrf,
    "360loc": _loc360,
    "insta360": _insta360,
    "pairs": _pairs,
    "triplets": _triplets,
}


_T = TypeVar("_T")

RESERVED = frozenset(
    {
        *("oa_minia", "oa_koth1", "mictf1beta", "hydronex", "hydronex2", "sleekgrinder", "pul1duel-oa", "oacmpdm1"),
        *("oa_shouse", "strength", "bleach"),
    }
)
"""Names of maps; their triplets are called NAME_NUMBER."""

_NUMBER = re.compile(r"(_\d+)+$")


def is_reserved(name: str) -> bool:
    """Whether a triplet of that name is of a reserved map."""
    return name.lower() in RESERVED or _NUMBER.sub("", name.lower()) in RESERVED


def without_reserved(items: Iterable[_T], name_of: Callable[[_T], str], folder: Path) -> list[_T]:
    """What may be trained on; a warning tells how many were left out.

    Raises:
        InputError: nothing is left.
    """
    given = list(items)
    kept = [item for item in given if not is_reserved(name_of(item))]
    if given and not kept:
        raise InputError(
            f"{folder}: needed something to train on, got {len(given)} triplets of reserved maps only "
            f"({', '.join(sorted(RESERVED))}), which are for evaluation; take other maps."
        )
    if len(kept) < len(given):
        warnings.warn(
            f"{folder}: {len(given) - len(kept)} of {len(given)} triplets are of maps reserved for evaluation, and "
            "are left out.",
            stacklevel=3,
        )
    return kept
