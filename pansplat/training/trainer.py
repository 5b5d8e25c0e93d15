"""The run: batches in, weights out; looked at, saved and gone on with exactly.

What step n learns is decided by the settings, the seed and n alone, and by the state that checkpoints keep: weights,
optimizer, running mean and random numbers. So a run that was killed goes on as if nothing had happened.
"""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from pansplat.atomic import replacing
from pansplat.data.loader import Loader
from pansplat.data.views import Batch
from pansplat.errors import InputError
from pansplat.model.mvsplat import MVSplat
from pansplat.model.weights import pack_weights
from pansplat.training import validation
from pansplat.training.checkpoint import load_latest, save_checkpoint
from pansplat.training.config import TrainConfig, as_json, require_same
from pansplat.training.datasets import sources
from pansplat.training.distributed import ProcessGroup, convert_sync_batch_norm, data_parallel
from pansplat.training.logs import CsvTable, ProgressDisplay, TensorBoardLog, plot_run
from pansplat.training.losses import choose_perceptual
from pansplat.training.network import (
    build_auxiliary_heads,
    build_network,
    set_training_mode,
    trainable_parameters,
    write_weights,
)
from pansplat.training.optimization import ExponentialMovingAverage, one_cycle_rate
from pansplat.training.rendering import TargetRenderer
from pansplat.training.step import LOSS_TERMS, TrainingStep, accumulate_gradients

_BEYOND = 10  # steps that the schedule is longer than the training, as in the original
_COLUMNS = (*LOSS_TERMS, "rate", "gradient_norm", "seconds")


class Trainer:
    """A training run.

    Args:
        config: its settings.
        processes: who trains together.
        silent: tell nothing.

    Raises:
        InputError: settings, data or weights that cannot be used.
    """

    def __init__(self, config: TrainConfig, processes: ProcessGroup | None = None, *, silent: bool = False) -> None:
        config.check()
        self.config, self.processes = config, processes or ProcessGroup()
        self.silent = silent or not self.processes.is_first
        self.device = self.processes.device(config.device)
        self.processes.join(self.device)
        self.folder = config.out / "checkpoints"
        kept = load_latest(self.folder)
        if kept is not None:
            require_same(kept[1]["config"], config, kept[0])
        self.network = build_network(config.network, config.seed).to(self.device)
        convert_sync_batch_norm(self.network, self.processes)
        self.auxiliary = build_auxiliary_heads(self.network).to(self.device) if config.network.auxiliary else None
        self.optimizer = torch.optim.Adam(
            list(trainable_parameters(self.network, self.auxiliary)), lr=config.optimizer.rate
        )
        self.mean = ExponentialMovingAverage(self.network, config.optimizer.ema) if config.optimizer.ema else None
        perceptual = choose_perceptual(config.perceptual, device=self.device)
        self.teacher = TrainingStep(self.network, self.auxiliary, perceptual, config.loss, config.memory)
        self.step, self.source = 0, None
        if kept is not None:
            self._restore(kept[1])
            self.source = kept[0]
        self._lessons = data_parallel(self.teacher, self.processes)
        self._stop = False

    def train(self) -> bool:
        """Take the steps that are left; returns whether all are taken (False: it was asked to stop).

        Raises:
            InputError: a loss that is no number, a disk that is full, data that cannot be read.
        """
        out, total, first = self.config.out, self.config.optimizer.steps, self.processes.is_first
        out.mkdir(parents=True, exist_ok=True)
        table = scores = board = None
        if first:
            with replacing(out / "config.json") as partial:
                partial.write_text(as_json(self.config) + "\n")
            table = CsvTable(out / "log.csv", _COLUMNS, self.step)
            validated = 0 if self.source is None else self.step + 1
            scores = CsvTable(out / "validation.csv", ("height", *validation.MEASURES), validated)
            board = TensorBoardLog(out / "tensorboard")
        saved_at = time.monotonic()
        try:
            with ProgressDisplay(self.step, total, silent=self.silent) as watch, self._asked_to_stop(watch):
                watch.say(self._introduction())
                if self.source is not None:
                    watch.say(f"going on from {self.source}")
                elif self.config.validation.every and first:
                    self._validate(scores, board, watch)  # what the rest is to be better than
                for batches in self._batches():
                    began = time.perf_counter()
                    told = self._learn(batches)
                    told["seconds"] = time.perf_counter() - began
                    if table is not None and board is not None:
                        table.add(self.step, told)
                        board.add(self.step, told, "training")
                    self.step += 1
                    watch.show(self.step, told["loss"], told["seconds"])
                    stopped = self.processes.any(self._stop)
                    if self._is_due(self.config.validation.every) and first and not stopped:
                        self._validate(scores, board, watch)
                    late = time.monotonic() - saved_at > 60 * self.config.checkpoint.minutes
                    if self._is_due(self.config.checkpoint.every) or late or stopped or self.step == total:
                        self.save()
                        saved_at = time.monotonic()
                    if stopped and self.step < total:
                        watch.say(f"stopped after step {self.step}; the same command goes on from there")
                        return False
                self._finish(watch)
        finally:
            for open_file in (table, scores, board):
                if open_file is not None:
                    open_file.close()
        return True

    def save(self) -> None:
        """Write a checkpoint and forget the oldest."""
        if self.processes.is_first:
            save_checkpoint(self.folder, self.step, self._state(), keep=self.config.checkpoint.keep)
        self.processes.wait()

    def _batches(self) -> Iterator[list[Batch]]:
        """The batches of each step that is left, one a round of accumulation."""
        o, height, stream = self.config.optimizer, 0, None
        for step in range(self.step, o.steps):
            if stream is None or self.config.height_at(step) != height:
                height = self.config.height_at(step)
                stream = self._loader(height).batches(step * o.accumulate)
            yield [next(stream) for _ in range(o.accumulate)]

    def _loader(self, height: int) -> Loader:
        data, _ = sources(self.config.data, height, self.config.seed)
        return Loader(
            data,
            height=height,
            batch_size=self.config.optimizer.batch_size,
            seed=self.config.seed,
            workers=self.config.data.workers,
            augmentation=self.config.data.augmentation,
            rank=self.processes.rank,
            world_size=self.processes.count,
        )

    def _learn(self, batches: list[Batch]) -> dict[str, float]:
        """One step of the optimizer; returns what is told of it."""
        settings = self.config.optimizer
        rate = one_cycle_rate(self.step, settings.steps + _BEYOND, settings.rate)
        set_training_mode(self.network, self.config.network.frozen)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad()
        told = accumulate_gradients(self._lessons, batches)
        parameters = list(trainable_parameters(self.network, self.auxiliary))
        norm = float(torch.nn.utils.clip_grad_norm_(parameters, settings.clip))
        if self.processes.any(not (math.isfinite(told["loss"]) and math.isfinite(norm))):
            self._refuse(batches, told, norm)
        self.optimizer.step()
        if self.mean is not None:
            self.mean.update(self.network, self.step)
        return {**self.processes.mean(told), "rate": rate, "gradient_norm": norm}

    def _refuse(self, batches: list[Batch], told: dict[str, float], norm: float) -> None:
        """Keep what made a loss that is no number, and stop."""
        path = self.config.out / f"not_finite_{self.step:08d}_{self.processes.rank}.pt"
        self.config.out.mkdir(parents=True, exist_ok=True)
        fields = [{**vars(batch), "names": list(batch.names)} for batch in batches]
        with replacing(path) as partial:
            torch.save({"step": self.step, "batches": fields, "network": self.network.state_dict()}, partial)
        names = ", ".join(name for batch in batches for name in batch.names)
        raise InputError(
            f"step {self.step}: needed finite numbers, got a loss of {told['loss']} and a gradient of norm {norm} from "
            f"{names}; the batch and the weights before the step are in {path}. Look at the data, lower "
            "--optimizer.rate, and go on from the last checkpoint."
        )

    def _validate(self, scores: CsvTable | None, board: TensorBoardLog | None, watch: ProgressDisplay) -> None:
        settings, height = self.config.validation, self.config.height_at(max(self.step - 1, 0))
        _, source = sources(self.config.data, height, self.config.seed)
        with self._averaged():
            found = validation.validate(
                self.network,
                source,
                TargetRenderer(self.config.memory.style, self.config.memory.mixing, height),
                samples=settings.samples,
                pictures=settings.pictures,
                tiles=self.config.memory.tiles,
                folder=self.config.out / "pictures",
                name=f"step_{self.step:08d}",
            )
        if scores is not None and board is not None:
            scores.add(self.step, {"height": height, **found})
            board.add(self.step, found, "validation")
            plot_run(self.config.out)
        watch.say(
            f"step {self.step}: PSNR {found['psnr']:.2f} dB, SSIM {found['ssim']:.3f}, "
            f"depth off by {100 * found['depth_error']:.1f} %, over {settings.samples} samples"
        )

    @contextmanager
    def _averaged(self) -> Iterator[None]:
        """The network with its running mean for weights, if there is one."""
        if self.mean is None:
            yield
            return
        own = {name: tensor.clone() for name, tensor in self.network.state_dict().items()}
        self.network.load_state_dict(self.mean.state)
        try:
            yield
        finally:
            self.network.load_state_dict(own)

    def _finish(self, watch: ProgressDisplay) -> None:
        if self.processes.is_first:
            path = self.config.out / "model.safetensors"
            write_weights(path, self.network, None if self.mean is None else self.mean.state)
            watch.say(f"done: {path}; use it with `pansplat predict PAIR -o scene.ply --model {path}`")
        self.processes.wait()

    def _is_due(self, every: int) -> bool:
        return bool(every) and (self.step % every == 0 or self.step == self.config.optimizer.steps)

    def _state(self) -> dict[str, Any]:
        model = "mvsplat" if isinstance(self.network, MVSplat) else "pansplat"
        weights = pack_weights(model, self.network.config, {}, compat=self.network.compat)
        described = {"model": weights.model, "config": weights.config, "compat": weights.compat}
        return {
            "config": as_json(self.config),
            "weights": json.dumps(described),
            "network": self.network.state_dict(),
            "auxiliary": None if self.auxiliary is None else self.auxiliary.state_dict(),
            "mean": None if self.mean is None else self.mean.state,
            "optimizer": self.optimizer.state_dict(),
            "random": torch.get_rng_state(),
        }

    def _restore(self, state: dict[str, Any]) -> None:
        self.step = state["step"]
        self.network.load_state_dict(state["network"])
        if self.auxiliary is not None:
            self.auxiliary.load_state_dict(state["auxiliary"])
        if self.mean is not None:
            self.mean.load(state["mean"])
        self.optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["random"])

    def _introduction(self) -> str:
        learnt = sum(p.numel() for p in trainable_parameters(self.network, self.auxiliary))
        return (
            f"{self.config.network.shape}: {learnt:,} parameters learn, "
            f"{self.config.data.kind} at {', '.join(f'{h}x{2 * h}' for h in self.config.heights)}, "
            f"perceptual loss {getattr(self.teacher.perceptual, 'name', 'none')}, "
            f"{self.processes.count} process(es), from step {self.step} of {self.config.optimizer.steps}"
        )

    @contextmanager
    def _asked_to_stop(self, watch: ProgressDisplay) -> Iterator[None]:
        """The first Ctrl-C (or SIGTERM) ends the run after the step, saved; the second at once."""

        def ask(number: int, _: object) -> None:
            if self._stop:
                raise KeyboardInterrupt
            self._stop = True
            watch.say("stopping after this step; once more to stop at once")

        kinds = (signal.SIGINT, signal.SIGTERM)
        try:
            before = [signal.signal(kind, ask) for kind in kinds]
        except ValueError:  # only the main thread may listen
            before = []
        try:
            yield
        finally:
            for kind, handler in zip(kinds, before, strict=False):
                signal.signal(kind, handler)
