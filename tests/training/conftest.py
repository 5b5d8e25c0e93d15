"""Networks and samples that are small enough for fast training steps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pansplat.geometry.equirect import pixel_directions
from pansplat.inputs.views import Batch, Sample, Views, collate
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.networks.layers import Compat
from pansplat.training import network, trainer
from pansplat.training.config import CheckpointConfig, DataConfig, NetworkConfig, OptimizerConfig, TrainConfig
from pansplat.training.config import ValidationConfig as Validation


def micro_config() -> PanSplatConfig:
    """The smallest network with all stages; for panoramas with a height of 32."""
    channels = (8, 8, 8, 8)
    levels = tuple(SweepLevel(3 - i, 8, 4, 32) for i in range(3))
    return PanSplatConfig(
        features=FeaturePyramidConfig(channels, TransformerConfig(8, 1)),
        cost_volume=CostVolumeConfig(mono_channels=0, refinement="none", levels=levels),
        heads=HeadsConfig(feature_channels=channels, candidates=4, layers=1, adapter=AdapterConfig(degree=0)),
    )


class PaintedSphere:
    """A sample source: views inside a sphere of 3 m; sample n has the n-th random texture, `broken` samples are NaN."""

    def __init__(self, count: int = 8, broken: frozenset[int] = frozenset()) -> None:
        self.count, self.broken = count, broken

    def __len__(self) -> int:
        return self.count

    def sample(self, index: int, height: int, seed: int) -> Sample:
        generator = torch.Generator().manual_seed(index)
        waves, phases = (torch.randn(3, n, generator=generator) for n in (3, 1))
        rays = pixel_directions(height, 2 * height, dtype=torch.float32)
        if index in self.broken:
            phases = phases * torch.nan

        def views(places: tuple[float, ...]) -> Views:
            cam2world = torch.eye(4, dtype=torch.float64).repeat(len(places), 1, 1)
            cam2world[:, 0, 3] = torch.tensor(places, dtype=torch.float64)
            images, depths = [], []
            for x in places:
                along = x * rays[..., 0]
                depth = -along + (along.square() + 9 - x * x).sqrt()
                points = depth[..., None] * rays + torch.tensor((x, 0.0, 0.0))
                images.append(0.5 + 0.4 * torch.sin(torch.einsum("cd,hwd->chw", waves, points) + phases[:, :, None]))
                depths.append(depth)
            masks = torch.ones(len(places), height, 2 * height, dtype=torch.bool)
            return Views(torch.stack(images), cam2world, masks, 0.5, 10.0, tuple(map(str, places)), torch.stack(depths))

        return Sample(f"sphere_{index}", views((-0.3, 0.3)), views((0.1,)))


@pytest.fixture
def sphere() -> type[PaintedSphere]:
    return PaintedSphere


@pytest.fixture
def make_batch() -> Callable[..., Batch]:
    """Make a batch of painted spheres with a height of 32."""
    return lambda *numbers: collate([PaintedSphere().sample(n, 32, 0) for n in numbers or (0,)])


@pytest.fixture
def micro() -> Callable[..., PanSplat]:
    """Make a network from a seed, float64 by default."""

    def make(compat: Compat = "fixed", dtype: torch.dtype = torch.float64) -> PanSplat:
        torch.manual_seed(3)
        return PanSplat(micro_config(), compat).to(dtype)

    return make


@pytest.fixture
def micro_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., TrainConfig]:
    """Make settings of a run; trainers use a micro network and painted spheres while the fixture is active."""
    monkeypatch.setattr(network, "network_config", lambda shape: micro_config())
    monkeypatch.setattr(trainer, "load_sources", lambda data, height, seed: (PaintedSphere(), PaintedSphere(2)))
    monkeypatch.setattr(TrainConfig, "check", lambda self: None)

    def make(name: str = "run", steps: int = 4, **settings: object) -> TrainConfig:
        whole: dict = {
            "out": tmp_path / name,
            "heights": (32,),
            "perceptual": "structure",
            "device": "cpu",
            "data": DataConfig(workers=0),
            "network": NetworkConfig(shape="tiny"),
            "optimizer": OptimizerConfig(steps=steps, batch_size=1, rate=1e-3, ema=0.9),
            "validation": Validation(every=0),
            "checkpoint": CheckpointConfig(every=2),
        }
        return TrainConfig(**{**whole, **settings})

    return make
