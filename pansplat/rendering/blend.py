"""Deferred blending: renderings of single input views, mixed by distance and opacity.

Source: PanSplat, section 3.4 (deferred blending), for any number of views; docs/rendering.md, section 7.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.rendering.rasterize import Rendering


def blend(renderings: Sequence[Rendering], weights: Float[Tensor, "view"]) -> Rendering:
    """Mix pictures of the same size; at each pixel a view counts by its weight times its opacity there."""
    if len(renderings) < 1 or weights.shape != (len(renderings),):
        raise ValueError(
            f"`weights` must hold one number for each of at least one rendering, got shape "
            f"{tuple(weights.shape)} for {len(renderings)}"
        )
    color = torch.stack([r.color for r in renderings])
    alpha = torch.stack([r.alpha for r in renderings])
    depth = torch.stack([r.depth for r in renderings])
    weights = weights.to(alpha)[:, None, None]
    share = weights * alpha
    share = torch.where(share.sum(dim=0) > 0, share, alpha)  # where the views that count see nothing, the others do
    total = share.sum(dim=0)
    seen = total > 0
    share = torch.where(seen, share, weights) / torch.where(seen, total, torch.ones_like(total))
    mixed_alpha = torch.where(seen, (share * alpha).sum(dim=0), 0)
    mixed_depth = torch.where(seen, (share * depth).sum(dim=0), 0)
    return Rendering((share[:, None] * color).sum(dim=0), mixed_alpha, mixed_depth)
