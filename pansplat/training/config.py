"""Every setting of a training run. Frozen, typed, and each field's docstring is its help on the command line."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from pansplat.data.augment import Augmentation
from pansplat.errors import InputError
from pansplat.model.layers import AttentionPrecision, Compat, Precision
from pansplat.training.losses import CODE, LossWeights, PerceptualName

DataKind = Literal["generated", "panogrf", "360loc", "insta360", "pairs", "triplets"]
NetworkShape = Literal["paper", "small", "tiny", "mvsplat"]
Part = Literal["features", "cost_volume", "heads"]
Backpropagation = Literal["plain", "one-step", "two-step"]
Style = Literal["panorama", "cubemap", "original"]
Mixing = Literal["joint", "by_view"]


@dataclass(frozen=True)
class DataConfig:
    """What is trained on."""

    kind: DataKind = "generated"
    """generated: rooms made up on the way, no files. panogrf, 360loc, insta360: these data sets. pairs: a folder as
    `pansplat predict` takes it, with targets. triplets: NAME.json with NAME_0.png ... beside it."""
    root: Path | None = None
    """Folder of the data; none for generated."""
    validation_root: Path | None = None
    """Folder of the data to compare with for pairs and triplets; by default the same."""
    draws: int = 1000
    """Random pairs a sequence and epoch, of 360loc and insta360."""
    training_gap: Literal["uniform", "original"] = "uniform"
    """Frames between the inputs: drawn from all gaps, or always the least, as the original does."""
    workers: int = 2
    """Processes that read; 0 to read in this one."""
    augmentation: Augmentation | None = field(default_factory=Augmentation)
    """What may change in a sample; the original changes nothing."""


@dataclass(frozen=True)
class NetworkConfig:
    """What is trained."""

    shape: NetworkShape = "paper"
    """The paper's network, smaller ones of the same plan without the monocular network, or the MVSplat baseline."""
    compat: Compat = "fixed"
    """Whether to train with the original's defects ("official") or without."""
    precision: Precision = "float32"
    """Number type of the convolutions (mixed precision); weights, depths and positions stay float32."""
    attention_precision: AttentionPrecision = "float32"
    """What attention rounds its inputs to."""
    init: Path | None = None
    """Weights to begin with: a .safetensors, an original .ckpt, or a checkpoint of pansplat-train."""
    frozen: tuple[Part, ...] = ()
    """Parts that do not learn; their normalisation statistics stay as they are."""
    auxiliary: bool = False
    """Whether each level of the cost volume also draws a picture by itself (for data without true depth)."""


@dataclass(frozen=True)
class MemoryConfig:
    """How gradients are found, which is a matter of memory only."""

    backpropagation: Backpropagation = "plain"
    """plain: one graph. one-step: the heads' Gaussians tile by tile. two-step: and the picture face by face."""
    tiles: int = 1
    """Tiles along each side of the panorama."""
    style: Style = "panorama"
    """panorama: a ray a pixel. cubemap: six faces. original: six faces as the original code draws them."""
    mixing: Mixing = "joint"
    """joint: all views' Gaussians in one picture. by_view: a picture a view, mixed by distance."""


@dataclass(frozen=True)
class OptimizerConfig:
    """How the weights move."""

    steps: int = 1000
    batch_size: int = 2
    """Samples a step, process and round of accumulation."""
    accumulate: int = 1
    """Rounds of backpropagation a step."""
    rate: float = 2e-4
    """Of Adam, at the schedule's peak."""
    clip: float = 0.5
    """Largest norm of the gradient."""
    ema: float = 0.0
    """Decay of the running mean of the weights that is validated and written out; 0 for none."""


@dataclass(frozen=True)
class ValidationConfig:
    """What is looked at on the way."""

    every: int = 1000
    """Steps; 0 for never."""
    samples: int = 16
    """Compared each time, always the same."""
    pictures: int = 2
    """Written as PNG each time: what should be seen above what is."""


@dataclass(frozen=True)
class CheckpointConfig:
    """What is kept on disk."""

    every: int = 1000
    """Steps; 0 for never but at the end."""
    minutes: float = 10.0
    """And after so many minutes; infinity for never."""
    keep: int = 2
    """Older ones are deleted."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    out: Path = Path("runs/run")
    """Folder of the run; one that holds a checkpoint is gone on with."""
    heights: tuple[int, ...] = (512,)
    """Of the panoramas, pixels; several share the steps evenly, one after another (progressive resolution)."""
    seed: int = 111123
    perceptual: PerceptualName = "auto"
    """auto: LPIPS where its files are here, else a measure without weights."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    loss: LossWeights = field(default_factory=LossWeights)
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    memory: MemoryConfig = field(default_factory=MemoryConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)

    def height_at(self, step: int) -> int:
        """Of the panoramas of a step, pixels."""
        share = min(step, self.optimizer.steps - 1) * len(self.heights) // max(1, self.optimizer.steps)
        return self.heights[share]

    def check(self) -> None:
        """Refuse what cannot be trained.

        Raises:
            InputError: a setting out of range, or settings that do not go together.
        """
        o = self.optimizer
        wrong = [
            (o.steps < 1, "--optimizer.steps must be at least 1", o.steps),
            (o.batch_size < 1, "--optimizer.batch-size must be at least 1", o.batch_size),
            (o.accumulate < 1, "--optimizer.accumulate must be at least 1", o.accumulate),
            (not 0 < o.rate < math.inf, "--optimizer.rate must be positive", o.rate),
            (not o.clip > 0, "--optimizer.clip must be positive", o.clip),
            (not 0 <= o.ema < 1, "--optimizer.ema must be at least 0 and below 1", o.ema),
            (not self.heights or min(self.heights) < 64, "--heights must be 64 pixels or more", self.heights),
            (self.memory.tiles < 1, "--memory.tiles must be at least 1", self.memory.tiles),
            (self.checkpoint.keep < 1, "--checkpoint.keep must be at least 1", self.checkpoint.keep),
            (self.checkpoint.every < 0, "--checkpoint.every must not be negative", self.checkpoint.every),
            (self.validation.every < 0, "--validation.every must not be negative", self.validation.every),
        ]
        for is_wrong, needed, got in wrong:
            if is_wrong:
                raise InputError(f"{needed}, got {got}.")
        if self.data.kind != "generated" and self.data.root is None:
            raise InputError(
                f"--data.kind {self.data.kind} needs --data.root, the folder that holds the data, got none."
            )
        if self.network.auxiliary and self.network.shape == "mvsplat":
            raise InputError("--network.auxiliary needs a hierarchical cost volume, which the mvsplat baseline lacks.")
        if self.network.frozen and self.network.shape == "mvsplat":
            raise InputError("--network.frozen names parts of PanSplat, got the mvsplat baseline; leave it out.")


_FREE_TO_CHANGE = ("out", "device", "checkpoint", "validation")
"""Settings that another part of the same run may change without changing what is learnt."""


def as_json(config: TrainConfig) -> str:
    """All settings, resolved."""
    return json.dumps(dataclasses.asdict(config), default=str, indent=2)


def require_same(kept: str, config: TrainConfig, source: Path) -> None:
    """Refuse to go on with a run under other settings.

    Args:
        kept: what `as_json` made of the run's settings.

    Raises:
        InputError: naming the settings that differ.
    """
    old, new = json.loads(kept), json.loads(as_json(config))
    for free in _FREE_TO_CHANGE:
        old.pop(free, None), new.pop(free, None)
    for settings in (old, new):
        settings.get("data", {}).pop("workers", None)
    changed = _differences(old, new)
    if changed:
        raise InputError(
            f"{source}: this run was begun with other settings ({'; '.join(changed[:4])}); go on with the same, or "
            "give another --out."
        )


def _differences(old: object, new: object, name: str = "") -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = sorted(old.keys() | new.keys())
        return [line for key in names for line in _differences(old.get(key), new.get(key), f"{name}.{key}")]
    return [] if old == new else [f"{name.lstrip('.')} was {old}, now {new}"]


_TRIPLETS = 19_950
_SEQUENCES = 13
_MATTERPORT = DataConfig(kind="panogrf", workers=10, augmentation=None)
_PLAIN = MemoryConfig(style="cubemap")
_FOUR = MemoryConfig("two-step", 2, "cubemap")
_SIXTEEN = MemoryConfig("two-step", 4, "cubemap")
_FROZEN = ("features", "cost_volume")
_WITHOUT_DEPTH = replace(CODE, depth=0.0)


def _matterport(
    name: str,
    height: int,
    batch: int,
    epochs: int,
    loss: LossWeights,
    network: NetworkConfig,
    memory: MemoryConfig,
    validations: float = 1.0,
) -> TrainConfig:
    an_epoch = _TRIPLETS // batch
    return TrainConfig(
        out=Path("runs") / name,
        heights=(height,),
        perceptual="lpips-vgg",
        loss=loss,
        data=_MATTERPORT,
        network=network,
        memory=memory,
        optimizer=OptimizerConfig(steps=epochs * an_epoch, batch_size=batch),
        validation=ValidationConfig(every=int(an_epoch / validations)),
    )


def _hall(
    name: str, height: int, batch: int, epochs: int, draws: int, network: NetworkConfig, memory: MemoryConfig
) -> TrainConfig:
    an_epoch = _SEQUENCES * draws // batch
    return TrainConfig(
        out=Path("runs") / name,
        heights=(height,),
        perceptual="lpips-vgg",
        loss=_WITHOUT_DEPTH,
        data=DataConfig(kind="360loc", draws=draws, workers=10, augmentation=None, training_gap="original"),
        network=network,
        memory=replace(memory, mixing="by_view" if network.shape == "paper" else "joint"),
        optimizer=OptimizerConfig(steps=max(1, epochs * an_epoch), batch_size=batch),
    )


def _own(
    name: str, shape: str, heights: tuple[int, ...], steps: int, batch: int, rate: float, every: int
) -> TrainConfig:
    return TrainConfig(
        out=Path("runs") / name,
        heights=heights,
        perceptual="structure",
        loss=LossWeights(perceptual=0.1, depth=0.1),
        network=NetworkConfig(shape="tiny" if shape == "tiny" else "small"),
        optimizer=OptimizerConfig(steps=steps, batch_size=batch, rate=rate, clip=1.0, ema=0.99),
        validation=ValidationConfig(every=every, samples=4),
        checkpoint=CheckpointConfig(every=every),
    )


_MVSPLAT = NetworkConfig(shape="mvsplat")

PRESETS: dict[str, tuple[str, TrainConfig]] = {
    "tiny": (
        "no files, minutes on a CPU: a very small network on generated rooms, 64x128",
        _own("tiny", "tiny", (64,), 300, 2, 2e-3, 100),
    ),
    "small": (
        "no files, a day on a CPU: a small network on generated rooms, 128x256 then 256x512",
        _own("small", "small", (128, 256), 20_000, 2, 1e-3, 1000),
    ),
    "pansplat-256": (
        "the paper's first stage, Matterport3D at 256x512; needs weights of the monocular network in --network.init",
        _matterport("pansplat-256", 256, 6, 10, CODE, NetworkConfig(), _PLAIN),
    ),
    "pansplat-512": (
        "the second, 512x1024, from the first",
        _matterport("pansplat-512", 512, 2, 5, CODE, NetworkConfig(), _PLAIN),
    ),
    "pansplat-1024": (
        "heads only, 1024x2048, two-step, 2x2 tiles, from pansplat-512",
        _matterport("pansplat-1024", 1024, 3, 3, _WITHOUT_DEPTH, NetworkConfig(frozen=_FROZEN), _FOUR, 2),
    ),
    "pansplat-2048": (
        "heads only, 2048x4096, two-step, 4x4 tiles, from pansplat-512",
        _matterport("pansplat-2048", 2048, 1, 3, _WITHOUT_DEPTH, NetworkConfig(frozen=_FROZEN), _SIXTEEN, 2),
    ),
    "pansplat-512-360loc": (
        "real halls, 512x1024, with auxiliary heads, from pansplat-512",
        _hall("pansplat-512-360loc", 512, 2, 5, 1000, NetworkConfig(auxiliary=True), _PLAIN),
    ),
    "pansplat-1024-360loc": (
        "heads only, 1024x2048, from pansplat-512-360loc",
        _hall("pansplat-1024-360loc", 1024, 3, 200, 10, NetworkConfig(frozen=_FROZEN), _FOUR),
    ),
    "pansplat-2048-360loc": (
        "heads only, 2048x4096, from pansplat-1024-360loc",
        _hall("pansplat-2048-360loc", 2048, 1, 100, 10, NetworkConfig(frozen=_FROZEN), _SIXTEEN),
    ),
    "mvsplat-256": ("the baseline, 256x512", _matterport("mvsplat-256", 256, 6, 10, _WITHOUT_DEPTH, _MVSPLAT, _PLAIN)),
    "mvsplat-512": ("the baseline, 512x1024", _matterport("mvsplat-512", 512, 1, 10, _WITHOUT_DEPTH, _MVSPLAT, _PLAIN)),
    "mvsplat-512-360loc": (
        "the baseline on real halls, from mvsplat-512",
        _hall("mvsplat-512-360loc", 512, 1, 5, 1000, _MVSPLAT, _PLAIN),
    ),
}
