"""Deferred blending: images of single input views, mixed by nearness and alpha.

Source: PanSplat, section 3.4 (deferred blending), for any number of views; docs/rendering.md, section 7.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.rendering.rasterize import Rendering


def blend(renderings: Sequence[Rendering], weights: Float[Tensor, "view"]) -> Rendering:
    """Mix images of the same size and background; at each pixel a view's weight is multiplied by its alpha.

    The alpha of the image is the largest of the views, so that the views fill each other's holes. Where all views of
    positive weight are empty, the others are mixed in proportion to their alpha.
    """
    if len(renderings) < 1 or weights.shape != (len(renderings),):
        raise ValueError(
            f"`weights` must hold one number for each of at least one rendering, got shape "
            f"{tuple(weights.shape)} for {len(renderings)}"
        )
    color = torch.stack([r.color for r in renderings])
    alpha = torch.stack([r.alpha for r in renderings])
    depth = torch.stack([r.depth for r in renderings])
    background = renderings[0].background
    behind = None if background is None else background[:, None, None]
    if behind is not None:
        color = color - (1 - alpha)[:, None] * behind
    weights = weights.to(alpha)[:, None, None]
    weights = torch.where((weights * alpha).sum(dim=0) > 0, weights, torch.ones_like(weights))
    mix = weights * alpha
    total = mix.sum(dim=0)
    seen = total > 0
    total = torch.where(seen, total, torch.ones_like(total))
    mixed_alpha = alpha.amax(dim=0)
    mixed_color = (weights[:, None] * color).sum(dim=0) * (mixed_alpha / total)
    if behind is not None:
        mixed_color = mixed_color + (1 - mixed_alpha) * behind
    mixed_depth = torch.where(seen, (mix * depth).sum(dim=0) / total, 0)
    return Rendering(mixed_color, mixed_alpha, mixed_depth, background=background)
