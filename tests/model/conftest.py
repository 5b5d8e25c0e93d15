"""Weights and small networks for the tests of the model, and one run of the official network."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.model.network import NetworkPredictor, build_network, convert_checkpoint
from pansplat.model.pansplat import PanSplat
from pansplat.model.weights import WeightsFile

_HOOKED = (
    *("features", "features.encoder", "features.transformer", "mono_depth", "cost_volume"),
    *(f"cost_volume.levels.{level}.refine" for level in (3, 2, 1)),
)


@dataclass(frozen=True)
class OfficialRun:
    """A prediction with the official weights on the inputs of the golden fixtures.

    Attributes:
        inputs, outputs: of the modules in `_HOOKED`, by name.
    """

    network: PanSplat
    gaussians: Gaussians
    inputs: dict[str, Any]
    outputs: dict[str, Any]


@pytest.fixture(scope="session")
def official_weights(recipe_weights: dict[str, Tensor], as_lightning: Callable[..., dict[str, Any]]) -> WeightsFile:
    """The recipe's checkpoint, converted."""
    return convert_checkpoint(as_lightning(recipe_weights), "recipe")


@pytest.fixture(scope="session")
def run_official(official_weights: WeightsFile, golden: Callable[..., dict[str, Tensor]]) -> Callable[..., OfficialRun]:
    """Run the converted network as a predictor; each combination of arguments runs once."""

    @functools.cache
    def run(compat: str = "official", attention: str = "float32") -> OfficialRun:
        network = build_network(official_weights, compat, "recipe", attention_precision=attention)
        inputs, outputs = {}, {}

        def keep(name: str, given: tuple, output: object) -> None:
            inputs[name], outputs[name] = given[0], output

        for name in _HOOKED:
            network.get_submodule(name).register_forward_hook(
                lambda _, given, output, name=name: keep(name, given, output)
            )
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
def randomize() -> Callable[[torch.nn.Module], torch.nn.Module]:
    """Fill a network with float64 noise, so that no layer is an identity or zero; in eval mode."""

    def fill(module: torch.nn.Module) -> torch.nn.Module:
        generator = torch.Generator().manual_seed(5)
        module = module.double().eval()
        with torch.no_grad():
            for parameter in module.parameters():
                fan_in = max(1, parameter[0].numel())
                parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64) / fan_in**0.5)
        return module

    return fill
