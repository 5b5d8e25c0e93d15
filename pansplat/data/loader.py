"""Endless batches of samples, read by worker processes, the same whatever the number of workers.

What is in batch n is decided by the seed and n alone: each epoch is a permutation of the source, and what is random
about a sample comes from (seed, epoch, index). So a stopped run goes on by asking for the batches from its step on.
"""

from __future__ import annotations

import itertools
import multiprocessing
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.context import BaseContext

import numpy as np
from torch.utils.data import DataLoader, Dataset

from pansplat.data.augment import Augmentation, augment
from pansplat.data.sources import SampleSource
from pansplat.data.views import Batch, Sample, collate
from pansplat.errors import InputError

_MOST_FAILURES = 32  # samples in a row that cannot be read before we give up


@dataclass(frozen=True)
class Skipped:
    """A sample that could not be read, and why; `message` names the file."""

    index: int
    message: str


class Loader:
    """Batches of a source.

    Args:
        source: the samples; sent to the workers once.
        height: of the panoramas, pixels.
        batch_size: samples a batch (a process).
        seed: of the order and of all that is random in the samples.
        workers: processes that read; 0 to read in this one.
        augmentation: None for none.
        rank, world_size: number of this process and of all that train together; each gets its share of a step.

    Attributes:
        skipped: how often each unreadable sample was left out, by message. A warning says so the first time.

    Raises:
        InputError: an empty source, or numbers that make no batch.
    """

    def __init__(
        self,
        source: SampleSource,
        *,
        height: int,
        batch_size: int,
        seed: int = 0,
        workers: int = 0,
        augmentation: Augmentation | None = None,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        if len(source) == 0:
            raise InputError("needed at least one sample to train on, got an empty source; give other data.")
        if batch_size < 1 or workers < 0 or not 0 <= rank < world_size:
            raise InputError(
                f"needed batch_size >= 1, workers >= 0 and 0 <= rank < world_size, got {batch_size}, {workers}, {rank} "
                f"and {world_size}."
            )
        self.reader = _Reader(source, height, seed, augmentation)
        self.batch_size, self.workers, self.rank, self.world_size = batch_size, workers, rank, world_size
        self.skipped: Counter[str] = Counter()

    def batches(self, step: int = 0) -> Iterator[Batch]:
        """Batches from that step on, without end.

        Raises:
            InputError: so many samples in a row are unreadable that nothing can be wrong but all of them.
        """
        loader = DataLoader(
            self.reader,
            batch_sampler=self._positions(step),
            num_workers=self.workers,
            collate_fn=_keep,
            worker_init_fn=_leave_interrupts_to_the_trainer,
            multiprocessing_context=_context() if self.workers else None,
        )
        for read in loader:
            self._count(itertools.chain.from_iterable(skipped for _, skipped in read))
            samples = [sample for sample, _ in read if sample is not None]
            if len(samples) < len(read):
                raise InputError(self._none_left([skipped for _, skipped in read]))
            yield collate(samples)

    def _positions(self, step: int) -> Iterable[list[int]]:
        share = self.batch_size * self.world_size
        for number in itertools.count(step):
            first = number * share + self.rank * self.batch_size
            yield list(range(first, first + self.batch_size))

    def _count(self, skipped: Iterable[Skipped]) -> None:
        for failure in skipped:
            self.skipped[failure.message] += 1
            if self.skipped[failure.message] == 1:
                warnings.warn(
                    f"left out sample {failure.index} ({len(self.skipped)} unreadable so far): {failure.message}",
                    stacklevel=3,
                )

    def _none_left(self, failures: list[list[Skipped]]) -> str:
        worst = max(failures, key=len)
        examples = "\n  ".join(dict.fromkeys(failure.message for failure in worst[:3]))
        return (
            f"needed samples that can be read, got {len(worst)} in a row that cannot (of "
            f"{len(self.reader.source)}); check the first of them:\n  {examples}"
        )


def _leave_interrupts_to_the_trainer(_: int) -> None:
    """Ctrl-C in a terminal reaches the workers too; the step that is under way still needs them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class _Reader(Dataset[tuple[Sample | None, list[Skipped]]]):
    """The sample at a position of the endless sequence of epochs, and those that were left out for it."""

    def __init__(self, source: SampleSource, height: int, seed: int, augmentation: Augmentation | None) -> None:
        self.source, self.height, self.seed, self.augmentation = source, height, seed, augmentation

    def __getitem__(self, position: int) -> tuple[Sample | None, list[Skipped]]:
        count = len(self.source)
        epoch, place = divmod(position, count)
        order = _permutation(self.seed, epoch, count)
        skipped: list[Skipped] = []
        for k in range(min(count, _MOST_FAILURES)):  # an unreadable sample gives its place to the next in the epoch
            index = int(order[(place + k) % count])
            try:
                return self._read(epoch, index, place), skipped
            except (InputError, OSError) as error:
                skipped.append(Skipped(index, str(error)))
        return None, skipped

    def _read(self, epoch: int, index: int, place: int) -> Sample:
        """The place counts too, so that a sample read twice for an unreadable one differs."""
        seeds = np.random.SeedSequence((self.seed, epoch, index, place)).spawn(2)
        sample = self.source.sample(index, self.height, int(seeds[0].generate_state(1)[0]))
        if self.augmentation is None:
            return sample
        return augment(sample, self.augmentation, np.random.default_rng(seeds[1]))


@lru_cache(maxsize=4)
def _permutation(seed: int, epoch: int, count: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


def _keep(read: list[tuple[Sample | None, list[Skipped]]]) -> list[tuple[Sample | None, list[Skipped]]]:
    return read


def _context() -> BaseContext:
    """Fresh processes: a copy of this one could inherit locks that its threads hold."""
    return multiprocessing.get_context("spawn" if sys.platform == "win32" else "forkserver")
