"""Settings of every stage of the paper, and of small models of our own.

Source: OFFICIAL.md, section 14. "paper" presets take the weights of the losses that the original code used: those are
the published checkpoints. Numbers of steps follow from epochs, data and batch (about 20,000 triplets of Matterport3D;
13 sequences of 360Loc).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pansplat.training.config import (
    CheckpointConfig,
    DataConfig,
    MemoryConfig,
    NetworkConfig,
    OptimizerConfig,
    TrainConfig,
    ValidationConfig,
)
from pansplat.training.losses import CODE, LossWeights

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
