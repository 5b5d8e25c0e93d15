"""Settings of a training run, and presets. The docstring of each field is its help on the command line."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from pansplat.errors import InputError
from pansplat.networks.layers import Compat, Precision
from pansplat.system.options import Count, CountOrNone, Fraction, Minutes, Seed, check_numbers
from pansplat.system.strict_json import convert, parse_json
from pansplat.training.losses import CODE, LossWeights, PerceptualName

DataKind = Literal["room", "panogrf", "360loc", "pairs", "triplets"]
NetworkShape = Literal["paper", "small", "tiny"]
Part = Literal["features", "cost_volume", "heads"]
Backpropagation = Literal["plain", "two-step"]
Style = Literal["panorama", "cubemap"]
Mixing = Literal["joint", "by_view"]


@dataclass(frozen=True)
class DataConfig:
    """Training data."""

    kind: DataKind = "room"
    """room: a room of boxes in random proportions and colours, no files. panogrf, 360loc: these data sets.
    pairs: a folder as for `pansplat predict`, with targets. triplets: NAME.json with NAME_0.png ... next to it."""
    root: Path | None = None
    """Folder of the data; none for room."""
    validation_root: Path | None = None
    """Folder of the validation data of pairs and triplets; the same by default."""
    draws: Count = 1000
    """Random pairs per sequence and epoch, of 360loc."""
    training_gap: Literal["uniform", "original"] = "uniform"
    """Frames between the inputs: uniformly random, or always the smallest gap, as in the official code."""
    workers: Annotated[int, Meta(ge=0, le=256)] = 2
    """Processes that read data; 0 to read in the training process."""
    augmentation: bool = True
    """Random yaw, mirroring and colours of samples; the official code has none."""


@dataclass(frozen=True)
class NetworkConfig:
    """The network that is trained."""

    shape: NetworkShape = "paper"
    """The paper's network, or smaller ones with the same stages but no monocular network."""
    compat: Compat = "fixed"
    """Whether to train with the defects of the official code ("official") or without them."""
    precision: Precision = "float32"
    """Number type of the convolutions (mixed precision); weights, depths and positions stay float32."""
    attention_precision: Precision = "float32"
    """Number type to which the inputs of attention are rounded."""
    init: Path | None = None
    """Initial weights: a .safetensors of `pansplat convert` or of training, or an official .ckpt."""
    frozen: tuple[Part, ...] = ()
    """Parts that are not trained; their normalisation statistics do not change either."""
    auxiliary: bool = False
    """Whether images are also rendered from each level of the cost volume alone (for data without true depth)."""


@dataclass(frozen=True)
class MemoryConfig:
    """How gradients are computed; affects memory and time only."""

    backpropagation: Backpropagation = "plain"
    """plain: one graph. two-step: the image face by face, then the heads tile by tile."""
    tiles: Annotated[int, Meta(ge=1, le=64)] = 1
    """Number of tiles along each side of the panorama."""
    style: Style = "panorama"
    """panorama: one ray per pixel. cubemap: six cube faces."""
    mixing: Mixing = "joint"
    """joint: all views' Gaussians in one image. by_view: one image per view, blended by distance."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Optimisation of the weights."""

    steps: Count = 1000
    batch_size: Annotated[int, Meta(ge=1, le=4096)] = 2
    """Samples per step."""
    rate: Annotated[float, Meta(gt=0, le=1e3)] = 2e-4
    """Peak learning rate of Adam."""
    clip: Annotated[float, Meta(gt=0)] = 0.5
    """Largest norm of the gradient."""
    ema: Fraction = 0.0
    """Decay of the exponential moving average of the weights, which is validated and saved; 0 for none."""


@dataclass(frozen=True)
class ValidationConfig:
    """Validation during training."""

    every: CountOrNone = 1000
    """Steps; 0 for never."""
    samples: Count = 16
    """Samples per validation, always the same ones."""
    pictures: CountOrNone = 2
    """Images written as PNG per validation: the target above, the rendering below."""


@dataclass(frozen=True)
class CheckpointConfig:
    """Checkpoints on disk."""

    every: CountOrNone = 1000
    """Steps; 0 for the last step only."""
    minutes: Minutes = 10.0
    """Also after this number of minutes; infinity for never."""
    keep: Count = 2
    """Number of checkpoints to keep."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    out: Path = Path("runs/run")
    """Folder of the run; training is resumed from its latest checkpoint."""
    heights: tuple[Annotated[int, Meta(ge=64, le=8192, multiple_of=32)], ...] = (512,)
    """Heights of the panoramas, pixels; each is used for an equal number of steps (progressive resolution)."""
    seed: Seed = 111123
    perceptual: PerceptualName = "auto"
    """auto: LPIPS if its files are available, else a distance without weights."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    loss: LossWeights = field(default_factory=LossWeights)
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    memory: MemoryConfig = field(default_factory=MemoryConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)

    def height_at(self, step: int) -> int:
        """Height of the panoramas of a step, pixels."""
        index = min(step, self.optimizer.steps - 1) * len(self.heights) // max(1, self.optimizer.steps)
        return self.heights[index]

    def check(self) -> None:
        """Raise an InputError for settings that are out of range or contradict each other."""
        check_numbers(self, prefixed=True)
        if not self.heights:
            raise InputError("--heights must be at least one height, got none.")
        if (self.data.kind == "room") != (self.data.root is None):
            needed = (
                "no --data.root, because it is generated" if self.data.root else "--data.root, a folder of the data"
            )
            raise InputError(f"--data.kind {self.data.kind} needs {needed}, got {self.data.root or 'none'}.")


_CHANGEABLE = ("out", "device", "checkpoint", "validation")
"""Settings that do not affect the training result; they may change when a run is resumed."""


def as_json(config: TrainConfig) -> str:
    """All settings as JSON."""
    return json.dumps(dataclasses.asdict(config), default=str, indent=2)


def require_same(saved: str, config: TrainConfig, source: Path) -> None:
    """Check that a run is resumed with its own settings.

    Args:
        saved: settings of the run, from `as_json`.
        source: the checkpoint that error messages name.
    """
    where = f"{source}: config"
    old, new = convert(parse_json(saved, where), dict[str, Any], where), json.loads(as_json(config))
    for settings in (old, new):
        for name in _CHANGEABLE:
            settings.pop(name, None)
        settings["data"] = convert(settings.get("data", {}), dict[str, Any], f"{where}.data")
        settings["data"].pop("workers", None)
    changed = _differences(old, new)
    if changed:
        raise InputError(
            f"{source}: this run was started with other settings ({'; '.join(changed[:4])}); use the same settings, or "
            "give another --out."
        )


def _differences(old: object, new: object, name: str = "") -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        names = sorted(old.keys() | new.keys())
        return [line for key in names for line in _differences(old.get(key), new.get(key), f"{name}.{key}")]
    return [] if old == new else [f"{name.lstrip('.')} was {old}, now {new}"]


# Presets: the stages of the paper (docs/official.md, section 14), and small models. The paper's presets have the loss
# weights of the official code, with which the published checkpoints were trained. Numbers of steps follow from epochs,
# numbers of samples (19,950 triplets of Matterport3D, 13 training sequences of 360Loc) and batch sizes.

_MATTERPORT = DataConfig(kind="panogrf", workers=10, augmentation=False)
_LOC360 = DataConfig(kind="360loc", workers=10, augmentation=False, training_gap="original")
_TEN_DRAWS = replace(_LOC360, draws=10)
_PLAIN = MemoryConfig(style="cubemap")
_TILED_2X2 = MemoryConfig("two-step", 2, "cubemap")
_TILED_4X4 = MemoryConfig("two-step", 4, "cubemap")
_HEADS_ONLY = NetworkConfig(frozen=("features", "cost_volume"))
_WITHOUT_DEPTH = replace(CODE, depth=0.0)


def _paper_preset(
    data: DataConfig,
    height: int,
    batch: int,
    steps: int,
    loss: LossWeights,
    network: NetworkConfig,
    memory: MemoryConfig,
    every: int = 1000,
) -> TrainConfig:
    return TrainConfig(
        heights=(height,),
        perceptual="lpips-vgg",
        loss=loss,
        data=data,
        network=network,
        memory=replace(memory, mixing="joint" if data is _MATTERPORT else "by_view"),
        optimizer=OptimizerConfig(steps=steps, batch_size=batch),
        validation=ValidationConfig(every=every),
    )


def _small_preset(
    shape: NetworkShape, heights: tuple[int, ...], steps: int, batch: int, rate: float, every: int, data: DataConfig
) -> TrainConfig:
    return TrainConfig(
        heights=heights,
        perceptual="structure",
        loss=LossWeights(perceptual=0.1, depth=0.1),
        data=data,
        network=NetworkConfig(shape=shape),
        optimizer=OptimizerConfig(steps=steps, batch_size=batch, rate=rate, clip=1.0, ema=0.99),
        validation=ValidationConfig(every=every, samples=4),
        checkpoint=CheckpointConfig(every=every),
    )


_PRESETS: dict[str, tuple[str, TrainConfig]] = {
    "tiny": (
        "no files, about 4 minutes on two idle cores: a very small network, rooms of boxes, 64x128",
        _small_preset("tiny", (64,), 300, 2, 2e-3, 100, DataConfig(workers=0)),  # workers would take seconds to start
    ),
    "small": (
        "a day on a CPU: a small network, triplets (of `pansplat-homes`, for example), 128x256 then 256x512",
        _small_preset("small", (128, 256), 20_000, 2, 1e-3, 1000, DataConfig(kind="triplets")),
    ),
    "pansplat-256": (
        "the paper's first stage, Matterport3D at 256x512; --network.init must hold the monocular network's weights",
        _paper_preset(_MATTERPORT, 256, 6, 10 * 3325, CODE, NetworkConfig(), _PLAIN, 3325),
    ),
    "pansplat-512": (
        "the paper's second stage, 512x1024, from the first",
        _paper_preset(_MATTERPORT, 512, 2, 5 * 9975, CODE, NetworkConfig(), _PLAIN, 9975),
    ),
    "pansplat-1024": (
        "heads only, 1024x2048, two-step, 2x2 tiles, from pansplat-512",
        _paper_preset(_MATTERPORT, 1024, 3, 3 * 6650, _WITHOUT_DEPTH, _HEADS_ONLY, _TILED_2X2, 3325),
    ),
    "pansplat-2048": (
        "heads only, 2048x4096, two-step, 4x4 tiles, from pansplat-512",
        _paper_preset(_MATTERPORT, 2048, 1, 3 * 19_950, _WITHOUT_DEPTH, _HEADS_ONLY, _TILED_4X4, 9975),
    ),
    "pansplat-512-360loc": (
        "360Loc, 512x1024, with auxiliary heads, from pansplat-512",
        _paper_preset(_LOC360, 512, 2, 5 * 6500, _WITHOUT_DEPTH, NetworkConfig(auxiliary=True), _PLAIN),
    ),
    "pansplat-1024-360loc": (
        "heads only, 1024x2048, from pansplat-512-360loc",
        _paper_preset(_TEN_DRAWS, 1024, 3, 200 * 43, _WITHOUT_DEPTH, _HEADS_ONLY, _TILED_2X2),
    ),
    "pansplat-2048-360loc": (
        "heads only, 2048x4096, from pansplat-1024-360loc",
        _paper_preset(_TEN_DRAWS, 2048, 1, 100 * 130, _WITHOUT_DEPTH, _HEADS_ONLY, _TILED_4X4),
    ),
}

PRESETS = {name: (text, replace(config, out=Path("runs") / name)) for name, (text, config) in _PRESETS.items()}
"""Description and settings of each preset."""
