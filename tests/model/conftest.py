"""Fixtures of the model tests: official weights, one run of the official network, random weights and inputs."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.network import NetworkPredictor, build_network, convert_checkpoint
from pansplat.model.pansplat import PanSplat
from pansplat.networks.weights import WeightsFile

_HOOKED = (
    *("features", "features.encoder", "features.transformer", "mono_depth", "cost_volume"),
    *(f"cost_volume.levels.{level}.refine" for level in (3, 2, 1)),
)


@dataclass(frozen=True)
class OfficialRun:
    """A prediction with the recipe's weights for the inputs of the golden fixtures.

    Attributes:
        inputs, outputs: inputs and outputs of the modules in `_HOOKED`, by name.
    """

    network: PanSplat
    gaussians: Gaussians
    inputs: dict[str, Any]
    outputs: dict[str, Any]


@pytest.fixture(scope="session")
def official_weights(recipe_weights: dict[str, Tensor], as_lightning: Callable[..., dict[str, Any]]) -> WeightsFile:
    """Weights converted from a checkpoint of the golden recipe."""
    return convert_checkpoint(as_lightning(recipe_weights), "recipe")


@pytest.fixture(scope="session")
def run_official(official_weights: WeightsFile, golden: Callable[..., dict[str, Tensor]]) -> Callable[..., OfficialRun]:
    """Run the converted network as a predictor, once for each precision of attention."""

    @functools.cache
    def run(attention: str = "float32") -> OfficialRun:
        network = build_network(official_weights, "official", "recipe", attention_precision=attention)
        inputs, outputs = {}, {}

        for name in _HOOKED:

            def keep(_: object, arguments: tuple, output: object, name: str = name) -> None:
                inputs[name], outputs[name] = arguments[0], output

            network.get_submodule(name).register_forward_hook(keep)
        if attention != "float32":  # the monocular network has no attention
            network.mono_depth.forward = lambda _: run().outputs["mono_depth"]
        truth = golden("pansplat_64x128_fp32attn")
        scene = (truth[f"in.{name}"][0] for name in ("image", "extrinsics", "near", "far"))
        gaussians = NetworkPredictor("pansplat", network)(*scene)
        return OfficialRun(network, gaussians, inputs, outputs)

    return run


@pytest.fixture(scope="session")
def error() -> Callable[[Tensor, Tensor], float]:
    """Largest difference from a golden tensor, in its standard deviations."""
    return lambda found, expected: float((found - expected).abs().max() / expected.std())


@pytest.fixture(scope="session")
def make_inputs() -> Callable[..., tuple[Tensor, ...]]:
    """Make random images and rigid poses of a network, with near and far; float64."""

    def make(height: int = 64, views: int = 2, batch: int = 1) -> tuple[Tensor, ...]:
        generator = torch.Generator().manual_seed(1)
        poses = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
        quats = torch.randn(batch, views, 4, generator=generator, dtype=torch.float64)
        poses[..., :3, :3] = rotations_from_quats(quats)
        poses[..., :3, 3] = 0.3 * torch.randn(batch, views, 3, generator=generator, dtype=torch.float64)
        images = torch.rand(batch, views, 3, height, 2 * height, generator=generator, dtype=torch.float64)
        near, far = (torch.full((batch, views), bound, dtype=torch.float64) for bound in (0.5, 20.0))
        return images, poses, near, far

    return make
