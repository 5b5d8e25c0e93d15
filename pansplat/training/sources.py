"""From settings to what is trained on and what is compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from pansplat.data.dataset import Joined, PairSource, SequenceEvaluation, SequenceTraining, Source, TripletSource
from pansplat.data.insta360 import read_insta360
from pansplat.data.loc360 import read_loc360
from pansplat.data.pairs import load_pairs
from pansplat.data.samplers import BoundedSampler
from pansplat.data.synthetic import GeneratedScenes
from pansplat.data.triplets import read_game_maps, read_panogrf
from pansplat.training.config import DataConfig
from pansplat.training.reserved import without_reserved

_OTHER_HOMES = 1_000_003  # apart from the seeds of training
_FEW_DRAWS = 4  # pairs of each sequence to compare with


def sources(config: DataConfig, height: int, seed: int) -> tuple[Source, Source]:
    """What is trained on, and what is compared with on the way; the latter has one target a sample.

    Triplets of maps that are reserved for evaluation are in neither.

    Args:
        height: of the panoramas, which decides on the folder of some data sets.

    Raises:
        InputError: the data are not there, or wrong.
    """
    if config.kind == "generated":
        return GeneratedScenes(seed), GeneratedScenes(seed + _OTHER_HOMES)
    assert config.root is not None
    return _READERS[config.kind](config, config.root, height)


def _panogrf(config: DataConfig, root: Path, height: int) -> tuple[Source, Source]:
    training, validation = (read_panogrf(root, stage, height) for stage in ("train", "val"))
    return Joined([TripletSource(t) for t in training]), Joined([TripletSource(t) for t in validation])


def _loc360(config: DataConfig, root: Path, height: int) -> tuple[Source, Source]:
    sampler = BoundedSampler(2, 5, config.training_gap)
    training = SequenceTraining(read_loc360(root, "train"), sampler, config.draws)
    return training, SequenceEvaluation(read_loc360(root, "val"), lambda n: sampler.evaluation(n, _FEW_DRAWS))


def _insta360(config: DataConfig, root: Path, height: int) -> tuple[Source, Source]:
    sampler = BoundedSampler(2, 30, config.training_gap)
    films = read_insta360(root)
    validation = films if config.validation_root is None else read_insta360(config.validation_root)
    return (
        SequenceTraining(films, sampler, config.draws),
        SequenceEvaluation(validation, lambda n: sampler.evaluation(n, _FEW_DRAWS)),
    )


def _pairs(config: DataConfig, root: Path, height: int) -> tuple[Source, Source]:
    training, validation = (_pairs_of(folder) for folder in (root, config.validation_root or root))
    return training, validation


def _pairs_of(folder: Path) -> PairSource:
    pairs = [pair for pair in load_pairs(folder) if pair.targets]
    return PairSource(without_reserved(pairs, lambda pair: pair.name, folder), targets=1)


def _triplets(config: DataConfig, root: Path, height: int) -> tuple[Source, Source]:
    training, validation = (_game_maps(folder) for folder in (root, config.validation_root or root))
    return training, validation


def _game_maps(folder: Path) -> TripletSource:
    triplets = read_game_maps(folder)
    kept = without_reserved(triplets.sources, lambda source: source.stem, folder)
    return TripletSource(replace(triplets, sources=tuple(kept)))


_READERS: dict[str, Callable[[DataConfig, Path, int], tuple[Source, Source]]] = {
    "panogrf": _panogrf,
    "360loc": _loc360,
    "insta360": _insta360,
    "pairs": _pairs,
    "triplets": _triplets,
}
