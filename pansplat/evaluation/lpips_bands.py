"""LPIPS of a large picture band by band: the activations of a 4K picture and its gradient would take 30 GB.

A block of the classifier, the convolutions between two poolings, sees as many rows beyond a band as it has
convolutions. So a band of a block's output is computed of that many rows more, and what the borders of the band spoilt
is cut off. Backward, each band is computed again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

_FLOOR = 1e-20  # squared length of a pixel's activations: none at all has a direction of zeros, and a gradient


def distances(
    a: Float[Tensor, "batch channel height width"],
    b: Float[Tensor, "batch channel height width"],
    head: Float[Tensor, "channel"],
) -> Float[Tensor, "batch height width"]:
    """How far the directions of two pictures' activations are apart at each pixel, channels weighed by `head`."""
    return torch.einsum("bchw,c->bhw", (_directions(a) - _directions(b)).square(), head)


def banded_distances(
    a: Float[Tensor, "batch channel height width"],
    b: Float[Tensor, "batch channel height width"],
    layers: nn.Sequential,
    heads: Iterable[Float[Tensor, "_"]],
    pixels: int,
) -> Iterator[Float[Tensor, "batch _ _"]]:
    """`distances` after each block of a classifier of 3x3 convolutions with a margin, rectifiers and 2x2 poolings.

    Args:
        heads: one a block.
        pixels: of a band, at the resolution of its block.
    """
    needs_gradient = torch.is_grad_enabled() and (a.requires_grad or b.requires_grad)
    for block, head in zip(_blocks(layers), heads, strict=True):
        height, width = a.shape[-2:]
        rows = max(2, pixels // width // 2 * 2)  # even: a pooling's rows stay together
        parts = []
        for first in range(0, height, rows):
            given = (block, a, b, head, first, min(first + rows, height))
            parts.append(
                checkpoint(_band, *given, use_reentrant=False, preserve_rng_state=False)
                if needs_gradient
                else _band(*given)
            )
        a, b = (torch.cat([part[i] for part in parts], dim=2) for i in (0, 1))
        yield torch.cat([part[2] for part in parts], dim=1)


def _blocks(layers: nn.Sequential) -> list[nn.Sequential]:
    """The layers up to each pooling, and those after the last."""
    ends = [index + 1 for index, layer in enumerate(layers) if isinstance(layer, nn.MaxPool2d)]
    bounds = [0, *ends, len(layers)]
    return [layers[start:end] for start, end in itertools.pairwise(bounds)]


def _band(
    block: nn.Sequential, a: Tensor, b: Tensor, head: Tensor, first: int, end: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Both pictures' rows for the next block, and the distances in this."""
    pooling = block[-1] if isinstance(block[-1], nn.MaxPool2d) else nn.Identity()
    convolving = block[:-1] if isinstance(block[-1], nn.MaxPool2d) else block
    margin = sum(isinstance(layer, nn.Conv2d) for layer in convolving)
    above, below = min(margin, first), min(margin, a.shape[2] - end)
    a, b = (convolving(maps[:, :, first - above : end + below])[:, :, above : above + end - first] for maps in (a, b))
    return (*(_pooled(pooling, maps) for maps in (a, b)), distances(a, b, head))


def _pooled(pooling: nn.Module, maps: Tensor) -> Tensor:
    """The last row of an odd number is lost, and it may be a band."""
    is_lost = isinstance(pooling, nn.MaxPool2d) and maps.shape[2] == 1
    return maps[:, :, :0, : maps.shape[3] // 2] if is_lost else pooling(maps)


def _directions(maps: Float[Tensor, "batch channel height width"]) -> Float[Tensor, "batch channel height width"]:
    """Activations divided by their length over the channels."""
    return maps * (maps.square().sum(1, keepdim=True) + _FLOOR).rsqrt()
