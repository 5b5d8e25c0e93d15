"""Samples by number, from whatever holds them.

A source is anything with a length and `sample(index, height, seed)`. The same three numbers give the same sample,
in any process; `seed` decides what is drawn at random (frames of a sequence, one of several targets).
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pansplat.data.frames import FrameSequence, read_draw
from pansplat.data.pair import Pair
from pansplat.data.sample import Sample
from pansplat.data.samplers import BoundedSampler, Draw
from pansplat.data.triplets import TripletSet
from pansplat.errors import InputError


class Source(Protocol):
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
class SequenceTraining:
    """Random pairs of frames, `draws` from each sequence an epoch."""

    sequences: Sequence[FrameSequence]
    sampler: BoundedSampler
    draws: int = 1000

    def __len__(self) -> int:
        return len(self.sequences) * self.draws

    def sample(self, index: int, height: int, seed: int) -> Sample:
        sequence = self.sequences[index // self.draws]
        draw = self.sampler.training(len(sequence.poses), np.random.default_rng((seed, index)))
        return read_draw(sequence, draw, height)


class SequenceEvaluation:
    """Chosen pairs of frames of each sequence, with all their targets.

    Args:
        sequences: posed frames.
        draws: from a number of frames to the pairs of a sequence that long, such as `BoundedSampler().evaluation`.
    """

    def __init__(self, sequences: Sequence[FrameSequence], draws: Callable[[int], Sequence[Draw]]) -> None:
        self.cases = [(sequence, draw) for sequence in sequences for draw in draws(len(sequence.poses))]

    def __len__(self) -> int:
        return len(self.cases)

    def sample(self, index: int, height: int, seed: int) -> Sample:
        return read_draw(*self.cases[index], height)


class Joined:
    """Several sources one after another."""

    def __init__(self, sources: Sequence[Source]) -> None:
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
