"""Infinite batches of samples, read by worker processes.

Batch n is determined by the seed and n, for any number of workers: each epoch is a permutation of the source, and the
random numbers of a sample are seeded by (seed, epoch, index). A run can therefore be resumed at any step.
"""

from __future__ import annotations

import itertools
import multiprocessing
import signal
import sys
import warnings
from collections.abc import Iterable, Iterator
from functools import lru_cache
from multiprocessing.context import BaseContext

import numpy as np
from torch.utils.data import DataLoader, Dataset

from pansplat.errors import InputError
from pansplat.inputs.views import Batch, Sample, collate
from pansplat.training.augment import augment
from pansplat.training.sources import SampleSource

_MAX_FAILURES = 32  # consecutive unreadable samples before an error

Read = tuple[Sample | None, list[str]]
"""A sample, and why others that it replaces could not be read; None if too many in a row could not."""


class Loader:
    """Batches of a source.

    Args:
        source: the samples; sent to the workers once.
        height: height of the panoramas, pixels.
        batch_size: samples per batch.
        seed: seed of the order and of the samples' random numbers.
        workers: processes that read; 0 to read in this process.
        augmentation: whether samples are changed at random.

    Attributes:
        skipped: why samples could not be read, with their files. The first time it warns.
    """

    def __init__(
        self,
        source: SampleSource,
        *,
        height: int,
        batch_size: int,
        seed: int = 0,
        workers: int = 0,
        augmentation: bool = False,
    ) -> None:
        if len(source) == 0:
            raise InputError("needed at least one sample, got an empty source; give other data.")
        if batch_size < 1 or workers < 0:
            raise InputError(f"needed batch_size >= 1 and workers >= 0, got {batch_size} and {workers}.")
        self.reader = _Reader(source, height, seed, augmentation)
        self.batch_size, self.workers = batch_size, workers
        self.skipped: set[str] = set()

    def batches(self, step: int = 0) -> Iterator[Batch]:
        """Infinite batches, starting at a step."""
        loader = DataLoader(
            self.reader,
            batch_sampler=self._positions(step),
            num_workers=self.workers,
            collate_fn=_identity,
            worker_init_fn=_ignore_interrupts,
            multiprocessing_context=_worker_context() if self.workers else None,
        )
        for read in loader:
            samples: list[Sample] = []
            for sample, failures in read:
                self._report(failures)
                if sample is None:
                    raise InputError(
                        f"needed readable samples, got {len(failures)} consecutive unreadable ones (of "
                        f"{len(self.reader.source)}); check the first of them: {failures[0]}"
                    )
                samples.append(sample)
            yield collate(samples)

    def _positions(self, step: int) -> Iterable[list[int]]:
        for number in itertools.count(step):
            first = number * self.batch_size
            yield list(range(first, first + self.batch_size))

    def _report(self, failures: list[str]) -> None:
        """Warn of failures that are new."""
        for failure in failures:
            if failure not in self.skipped:
                self.skipped.add(failure)
                warnings.warn(f"skipped a sample ({len(self.skipped)} unreadable so far): {failure}", stacklevel=3)


def _ignore_interrupts(_: int) -> None:
    """Ignore Ctrl-C in a worker: a terminal sends it to all processes, but the current step needs the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


class _Reader(Dataset[Read]):
    """The sample at a position of the infinite sequence of epochs, and the samples that were skipped for it."""

    def __init__(self, source: SampleSource, height: int, seed: int, augmentation: bool) -> None:
        self.source, self.height, self.seed, self.augmentation = source, height, seed, augmentation

    def __getitem__(self, position: int) -> Read:
        count = len(self.source)
        epoch, place = divmod(position, count)
        order = _permutation(self.seed, epoch, count)
        failures: list[str] = []
        for k in range(min(count, _MAX_FAILURES)):  # the next sample of the epoch replaces an unreadable one
            index = int(order[(place + k) % count])
            try:
                return self._read(epoch, index, place), failures
            except (InputError, OSError) as error:
                failures.append(str(error))
        return None, failures

    def _read(self, epoch: int, index: int, place: int) -> Sample:
        """The sample at an index. The seed includes `place`, so that two reads of a sample in one epoch differ."""
        seeds = np.random.SeedSequence((self.seed, epoch, index, place)).spawn(2)
        sample = self.source.sample(index, self.height, int(seeds[0].generate_state(1)[0]))
        return augment(sample, np.random.default_rng(seeds[1])) if self.augmentation else sample


@lru_cache(maxsize=4)
def _permutation(seed: int, epoch: int, count: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


def _identity(read: list[Read]) -> list[Read]:
    return read


def _worker_context() -> BaseContext:
    """Start fresh processes: a fork could inherit locks that threads of this process hold."""
    return multiprocessing.get_context("spawn" if sys.platform == "win32" else "forkserver")
