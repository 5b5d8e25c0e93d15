"""Training of monocular depth and its refinement on pairs of panoramas from tours of generated homes.

`pansplat-homes train-depth --out RUN --tours SHARDS...` trains until it is stopped. The same command resumes.
The learning rate rises, stays, and falls in the last `decay_steps` before `steps`; a longer run can therefore continue
from a checkpoint of a shorter one. The tours are read anew at each start, so that more can be added.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from pansplat.errors import InputError
from pansplat.geometry.equirect import row_weights
from pansplat.inputs.views import Views
from pansplat.networks.depth_network import DepthEstimate
from pansplat.networks.depth_refinement import DepthRefinement, RefinementConfig
from pansplat.networks.layers import to_channels_last
from pansplat.networks.weights import load_weights
from pansplat.sweep.guided_sweep import save_network
from pansplat.system.files import require_output_folder
from pansplat.training.augment import mirror_views, roll_views
from pansplat.training.checkpoint import (
    list_checkpoints,
    load_checkpoint,
    load_latest,
    restore,
    restore_optimizer,
    save_checkpoint,
)
from pansplat.training.logs import CsvTable, ProgressDisplay
from pansplat.training.optimization import ExponentialMovingAverage
from pansplat.training.stopping import StopRequest
from pansplat_homes.camera import photograph
from pansplat_homes.imagenet import load_imagenet, read_imagenet_weights
from pansplat_homes.shards import ShardReader, Tour

MAX_DEPTH = 12.0  # in camera heights; surfaces farther away are all "far"
_TYPICAL_BASELINE = 2.0  # metres
_SCALES = (1, 2, 4)  # pixels, of the loss on differences between neighbours


@dataclass(frozen=True)
class DepthTrainConfig:
    """A training run of the depth network."""

    out: Path
    """Folder of the run."""
    tours: tuple[Path, ...]
    """Folders of shards of tours."""
    validation: Path | None = None
    """Folder of shards of tours that are not trained on."""
    seed: int = 0
    steps: int = 100_000
    decay_steps: int = 10_000
    """Steps at the end in which the learning rate falls to zero."""
    warm_up: int = 500
    """Steps at the start in which the learning rate rises."""
    pairs: int = 4
    """Pairs of panoramas in a batch."""
    rate: float = 4e-4
    encoder_rate: float = 2e-4
    weight_decay: float = 1e-2
    ema: float = 0.999
    clip: float = 5.0
    baseline: tuple[float, float] = (0.3, 4.5)
    """Smallest and largest distance of the cameras of a pair, metres, where a tour has such a pair."""
    minutes: float = 5.0
    """Minutes between checkpoints."""
    validate_every: int = 500
    validation_tours: int = 48
    threads: int = 1
    """Threads of torch on the CPU."""
    workers: int = 0
    """Processes that read and photograph pairs; 0 reads in the training process."""
    device: str = "cpu"
    stop_after_minutes: float = 0.0
    """Save and stop after so many minutes; 0 for none."""
    init: Path | None = None
    """File of weights, or checkpoint of another run, from whose weights the run starts."""
    factor_noise: tuple[float, float] = (0.1, 0.03)
    """Deviation of the logarithm of the monocular depth's factor: of both views together, and of each view."""
    network: RefinementConfig = field(default_factory=RefinementConfig)

    def run(self) -> int:
        """Train, and return the exit status of the command."""
        return run_trainer(DepthTrainer, self)


Sample = tuple[Views, Tensor]
"""Two views, and the heights of their cameras over the floor, metres."""


def read_pair(tours: ShardReader, index: int, rng: np.random.Generator, baseline: tuple[float, float]) -> Sample:
    """Two photographed and augmented panoramas of a tour, with the heights of their cameras over the floor, metres."""
    tour = tours.read(index)
    chosen = _choose_pair(tour, rng, baseline)
    photographs = photograph(tour.light[chosen], tour.depth[chosen], rng)
    depth = torch.from_numpy(tour.depth[chosen])
    views = Views(
        images=torch.from_numpy(photographs.images).permute(0, 3, 1, 2).contiguous(),
        cam2world=torch.from_numpy(tour.cam2world[chosen]),
        masks=torch.from_numpy(photographs.masks),
        near=0.3,
        far=20.0,
        names=(f"tour_{index}_{chosen[0]}", f"tour_{index}_{chosen[1]}"),
        depths=depth,
    )
    if rng.random() < 0.5:
        views = mirror_views(views)
    views = roll_views(views, rng.integers(depth.shape[-1], size=2).tolist())
    return views, torch.from_numpy(tour.camera_height[chosen]).float()


@dataclass(frozen=True)
class RandomPairs(Dataset[Sample]):
    """Pairs of random tours by position; the seed and the position determine all random numbers."""

    tours: ShardReader
    seed: int
    baseline: tuple[float, float]

    def __getitem__(self, position: int) -> Sample:
        rng = np.random.default_rng((self.seed, position))
        return read_pair(self.tours, int(rng.integers(len(self.tours))), rng, self.baseline)


def _choose_pair(tour: Tour, rng: np.random.Generator, baseline: tuple[float, float]) -> list[int]:
    centres = tour.cam2world[:, :3, 3]
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    fitting = np.argwhere((distance >= baseline[0]) & (distance <= baseline[1]))
    if len(fitting) == 0:
        return [int(k) for k in rng.permutation(len(centres))[:2]]
    nearness = np.exp(-distance[tuple(fitting.T)] / _TYPICAL_BASELINE)  # distant cameras often see different rooms
    return [int(k) for k in fitting[rng.choice(len(fitting), p=nearness / nearness.sum())]]


def depth_targets(
    views: Views, camera_height: Float[Tensor, "view"], generator: torch.Generator | None = None
) -> tuple[Float[Tensor, "view h w"], Bool[Tensor, "view h w"]]:
    """Log-depth in camera heights at half the size, and where it is known.

    Each value is that of one of the four pixels: a random one with a generator, else the first. The scene behind what
    is fixed to the camera counts, so that the network continues the floor under a tripod.
    """
    assert views.depths is not None
    blocks = views.depths.unflatten(-1, (-1, 2)).unflatten(-3, (-1, 2)).transpose(-2, -3).flatten(-2)
    chosen = torch.zeros(blocks.shape[:-1], dtype=torch.long)
    if generator is not None:
        chosen = torch.randint(4, blocks.shape[:-1], generator=generator)
    depth = blocks.gather(-1, chosen[..., None]).squeeze(-1)
    relative = (depth / camera_height[:, None, None]).clamp(1e-3, MAX_DEPTH)
    return relative.log(), depth > 0


def depth_loss(
    estimate: DepthEstimate, target: Float[Tensor, "batch h w"], known: Bool[Tensor, "batch h w"]
) -> dict[str, Tensor]:
    """Loss terms: the likelihood, absolute error, and differences between neighbours; weighted by solid angle."""
    weight = known * row_weights(known.shape[-2], dtype=torch.float32)[:, None].to(known.device)
    weight = weight / weight.sum().clamp_min(1e-6)
    error = estimate.log_depth - target
    absolute = error.abs()
    likelihood = absolute * (-estimate.log_scale).exp() + estimate.log_scale
    differences = error.new_zeros(())
    for step in _SCALES:
        for axis in (-1, -2):
            there = error.roll(-step, axis)
            both = weight * known.roll(-step, axis)
            if axis == -2:
                both = both[..., :-step, :]
                difference = (there - error)[..., :-step, :]
            else:
                difference = there - error
            differences = differences + (both * difference.abs()).sum() / len(_SCALES)
    return {
        "loss": (weight * likelihood).sum() + (weight * absolute).sum() + differences,
        "log_depth_error": (weight * absolute).sum(),
        "relative_error": (weight * ((error).exp() - 1).abs()).sum(),
        "likelihood": (weight * likelihood).sum(),
    }


_PAIR_OF_VIEWS = [(0, 1), (1, 0)]


def training_terms(
    network: DepthRefinement,
    samples: list[Sample],
    generator: torch.Generator | None,
    *,
    iterations: int,
    factor_noise: tuple[float, float] = (0.0, 0.0),
) -> dict[str, Tensor]:
    """Loss terms of monocular depth and of its refinement, for pairs of views with their cameras' heights."""
    device = network.candidates.device
    images = torch.cat([views.images for views, _ in samples]).to(device)
    heights = torch.cat([heights for _, heights in samples])
    poses = torch.cat([views.cam2world for views, _ in samples]).to(device)
    targets, known = zip(*(depth_targets(views, h, generator) for views, h in samples), strict=True)
    target, is_known = torch.cat(targets).to(device), torch.cat(known).to(device)
    mono, observed = network.observe(to_channels_last(images))
    terms = {f"mono_{name}": value for name, value in depth_loss(mono, target, is_known).items()}
    loss = terms.pop("mono_loss")
    noise = torch.zeros(len(heights))
    if generator is not None:
        noise = torch.randn(len(samples), generator=generator).repeat_interleave(2) * factor_noise[0]
        noise = noise + torch.randn(len(heights), generator=generator) * factor_noise[1]
    factor, noise = heights.log()[:, None, None].to(device), noise[:, None, None].to(device)
    estimate = DepthEstimate(mono.log_depth + factor + noise, mono.log_scale)
    pairs = [(2 * n + i, 2 * n + j) for n in range(len(samples)) for i, j in _PAIR_OF_VIEWS]
    for _ in range(iterations):
        estimate = network.refine(observed, estimate, poses, pairs)
        refined = depth_loss(DepthEstimate(estimate.log_depth - factor, estimate.log_scale), target, is_known)
        loss = loss + refined["loss"] / iterations
    terms |= {f"refined_{name}": value for name, value in refined.items() if name != "loss"}
    terms = {name.replace("log_depth_error", "error"): value for name, value in terms.items()}
    return {"loss": loss, **terms}


class DepthTrainer:
    """A training run, resumed from its latest checkpoint if there is one.

    A subclass trains another network with other terms.
    """

    TERMS: ClassVar[tuple[str, ...]] = (
        "loss", "mono_error", "mono_likelihood", "mono_relative_error",
        "refined_error", "refined_likelihood", "refined_relative_error",
    )  # fmt: skip

    def __init__(self, config: DepthTrainConfig, *, silent: bool = False) -> None:
        self.config, self.silent = config, silent
        torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.tours = ShardReader(list(config.tours))
        self.device = torch.device(config.device)
        self.network = self.make_network()
        self.step = 0
        if next(iter(list_checkpoints(config.out / "checkpoints")), None) is None:
            self.load_start(config.init)
        self.network.to(self.device, memory_format=torch.channels_last)
        encoder, rest = [], []
        for name, parameter in self.network.named_parameters():
            (encoder if "encoder." in name else rest).append(parameter)
        self.optimizer = torch.optim.AdamW(
            [{"params": rest, "peak": config.rate}, {"params": encoder, "peak": config.encoder_rate}],
            lr=config.rate,
            weight_decay=config.weight_decay,
        )
        self.average = ExponentialMovingAverage(self.network, config.ema)
        load_latest(config.out / "checkpoints", self._restore)
        self.stop = StopRequest()

    def make_network(self) -> Any:
        """The network with random weights."""
        return DepthRefinement(self.config.network)

    def load_start(self, path: Path | None) -> None:
        """Load the weights that a new run starts from: of a file, or those of the encoder."""
        if path is None:
            load_imagenet(self.network.mono.encoder, read_imagenet_weights())
        else:
            load_matching(self.network, path)

    def compute_terms(
        self, network: Any, samples: list[Sample], generator: torch.Generator | None
    ) -> dict[str, Tensor]:
        """Loss terms of a batch; without a generator those of a validation."""
        if generator is None:
            return training_terms(network, samples, None, iterations=2)
        iterations = 2 if self.step % 4 == 0 else 1
        return training_terms(network, samples, generator, iterations=iterations, factor_noise=self.config.factor_noise)

    def save_network(self, path: Path) -> None:
        """Write the averaged weights."""
        save_network(path, self.network, self.average.state)

    def _restore(self, path: Path, state: dict[str, Any]) -> None:
        """Restore the run from a checkpoint; a DamagedCheckpointError if it does not fit."""
        restore(state, "step", int)  # checked before anything is restored
        restore(state, "network", self.network.load_state_dict)
        restore(state, "mean", self.average.load)
        restore(state, "optimizer", partial(restore_optimizer, self.optimizer))
        self.step = state["step"]

    def train(self) -> bool:
        """Train the remaining steps. Returns whether all were done."""
        config = self.config
        config.out.mkdir(parents=True, exist_ok=True)
        log = CsvTable(config.out / "log.csv", (*self.TERMS, "rate", "gradient_norm", "seconds"), self.step)
        scores = CsvTable(config.out / "validation.csv", self.TERMS[1:], self.step + 1)
        began = saved = time.monotonic()
        try:
            with ProgressDisplay(self.step, config.steps, silent=self.silent) as display, self.stop.on_signal(display):
                display.print(f"from step {self.step} of {config.steps}, {len(self.tours)} tours")
                for samples in self._batches():
                    values = self._optimize(samples)
                    log.add(self.step, values)
                    self.step += 1
                    display.update(self.step, values["loss"], values["seconds"])
                    now = time.monotonic()
                    if config.stop_after_minutes and now - began > 60 * config.stop_after_minutes:
                        self.stop.requested, self.stop.status = True, 0
                    if config.validation is not None and self.step % config.validate_every == 0:
                        measures = self.validate()
                        scores.add(self.step, measures)
                        display.print(f"step {self.step}: " + ", ".join(f"{k} {v:.4f}" for k, v in measures.items()))
                    if now - saved > 60 * config.minutes or self.stop.requested or self.step == config.steps:
                        self.save()
                        saved = now
                    if self.stop.requested:
                        break
        finally:
            log.close()
            scores.close()
        return self.step >= config.steps

    def save(self) -> None:
        """Write a checkpoint and the averaged weights, and delete old checkpoints."""
        state = {
            "config": json.dumps(dataclasses.asdict(self.config), default=str),
            "network": self.network.state_dict(),
            "mean": self.average.state,
            "optimizer": self.optimizer.state_dict(),
        }
        save_checkpoint(self.config.out / "checkpoints", self.step, state, keep=2)
        self.save_network(self.config.out / "model.safetensors")

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Mean measures of the averaged weights over the validation tours."""
        assert self.config.validation is not None
        tours = ShardReader([self.config.validation])
        network = self.make_network()
        network.load_state_dict(self.average.state)
        network.to(self.device).eval()
        sums = dict.fromkeys(self.TERMS[1:], 0.0)
        count = min(self.config.validation_tours, len(tours))
        for index in range(count):
            views, heights = read_pair(tours, index, np.random.default_rng(index), self.config.baseline)
            terms = self.compute_terms(network, [(views, heights)], None)
            for name in sums:
                sums[name] += float(terms[name]) / count
        return sums

    def _learning_rate_factor(self) -> float:
        rise = min(1.0, (self.step + 1) / max(1, self.config.warm_up))
        left = (self.config.steps - self.step) / max(1, self.config.decay_steps)
        return rise * min(1.0, left)

    def _batches(self) -> Iterator[list[Sample]]:
        """The pairs of each remaining step."""
        steps = range(self.step, self.config.steps)
        pairs = RandomPairs(self.tours, self.config.seed, self.config.baseline)
        loader = DataLoader(
            pairs,  # pyright: ignore[reportArgumentType]
            batch_sampler=[range(n * self.config.pairs, (n + 1) * self.config.pairs) for n in steps],
            num_workers=self.config.workers,
            collate_fn=list,
            multiprocessing_context="spawn" if self.config.workers else None,
        )
        return iter(loader)

    def _optimize(self, samples: list[Sample]) -> dict[str, float]:
        began = time.perf_counter()
        generator = torch.Generator().manual_seed(self.step)
        factor = self._learning_rate_factor()
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * factor
        self.network.train()
        terms = self.compute_terms(self.network, samples, generator)
        self.optimizer.zero_grad()
        terms["loss"].backward()
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.clip))
        loss = float(terms["loss"].detach())
        if not (math.isfinite(loss) and math.isfinite(norm)):
            raise InputError(f"step {self.step}: needed finite numbers, got a loss of {loss}; lower --rate.")
        self.optimizer.step()
        self.average.update(self.network, self.step)
        return {
            **{name: float(terms[name].detach()) for name in self.TERMS},
            "rate": self.config.rate * factor,
            "gradient_norm": norm,
            "seconds": time.perf_counter() - began,
        }


def load_matching(network: DepthRefinement, path: Path) -> None:
    """Load the weights of a file, or the averaged weights of a checkpoint, that fit the network's names and shapes."""
    state = load_weights(path).tensors if path.suffix == ".safetensors" else load_checkpoint(path)["mean"]
    own = network.state_dict()
    fitting = {name: t for name, t in state.items() if name in own and own[name].shape == t.shape}
    if not fitting:
        raise InputError(f"{path}: needed weights of a depth network, got {len(state)} of another one.")
    network.load_state_dict({**own, **fitting})


def run_trainer(trainer_type: type[DepthTrainer], config: DepthTrainConfig) -> int:
    """Train, and return the exit status of the command."""
    require_output_folder("--out", config.out)
    trainer = trainer_type(config)
    return 0 if trainer.train() else trainer.stop.status
