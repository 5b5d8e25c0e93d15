"""Weights for the networks under test."""

from collections.abc import Callable

import pytest
import torch

from pansplat.model.weights import official_names


@pytest.fixture(scope="session")
def load_recipe(recipe_weights: dict[str, torch.Tensor]) -> Callable[[torch.nn.Module, str], torch.nn.Module]:
    """Give a part of PanSplat, such as "features", the recipe's weights; ready to predict."""

    def load(module: torch.nn.Module, part: str) -> torch.nn.Module:
        shapes = {name: tensor.shape for name, tensor in module.state_dict().items()}
        names = {ours.removeprefix(f"{part}."): theirs for theirs, ours in official_names("pansplat").items()}
        module.load_state_dict({name: recipe_weights[names[name]].reshape(shapes[name]) for name in shapes})
        return module.eval()

    return load


@pytest.fixture(scope="session")
def randomize() -> Callable[[torch.nn.Module], torch.nn.Module]:
    """Fill a network with float64 noise, so that no part of it does nothing; ready to predict."""

    def fill(module: torch.nn.Module) -> torch.nn.Module:
        generator = torch.Generator().manual_seed(5)
        module = module.double().eval()
        with torch.no_grad():
            for parameter in module.parameters():
                fan_in = max(1, parameter[0].numel())
                parameter.copy_(torch.randn(parameter.shape, generator=generator, dtype=torch.float64) / fan_in**0.5)
        return module

    return fill
