"""Deferred blending: images of single input views, mixed by nearness and alpha.

Source: PanSplat, section 3.4 (deferred blending), for any number of views; docs/rendering.md, section 7.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.rendering.rasterize import Rendering


def blend(renderings: Sequence[Rendering], weights: Float[Tensor, "view"]) -> Rendering:
    """Mix images of the same size; at each pixel a view's weight is multiplied by its alpha.

    Where all views of positive weight are empty, the others are mixed in proportion to their alpha.
    """
    if len(renderings) < 1 or weights.shape != (len(renderings),):
        raise ValueError(
            f"`weights` must hold one number for each of at least one rendering, got shape "
            f"{tuple(weights.shape)} for {len(renderings)}"
        )
    color = torch.stack([r.color for r in renderings])
    alpha = torch.stack([r.alpha for r in renderings])
    depth = torch.stack([r.depth for r in renderings])
    weights = weights.to(alpha)[:, None, None]
    mix = weights * alpha
    mix = torch.where(mix.sum(dim=0) > 0, mix, alpha)
    total = mix.sum(dim=0)
    seen = total > 0
    mix = torch.where(seen, mix, weights) / torch.where(seen, total, torch.ones_like(total))
    mixed_alpha = torch.where(seen, (mix * alpha).sum(dim=0), 0)
    mixed_depth = torch.where(seen, (mix * depth).sum(dim=0), 0)
    return Rendering((mix[:, None] * color).sum(dim=0), mixed_alpha, mixed_depth)
