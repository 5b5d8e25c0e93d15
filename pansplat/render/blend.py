"""Deferred blending: renderings of single input views, mixed by distance and opacity.

Source: PanSplat, section 3.4 (deferred blending), for any number of views; docs/rendering.md, section 7.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.render.reference import Rendering


def blend_weights(position: Float[Tensor, "3"], positions: Float[Tensor, "view 3"]) -> Float[Tensor, "view"]:
    """Weights of the input views at a camera position: inverse distances, normalised.

    Never negative, sum to one, one-hot at an input position, equal among inputs that coincide with the
    position.
    """
    if positions.shape[0] < 1:
        raise ValueError("`positions` must hold at least one view, got none")
    distances = torch.linalg.vector_norm(position - positions, dim=1)
    nearest = distances.detach().amin()
    at = distances == 0
    # Only ratios matter, so the nearest distance serves as the unit: nothing overflows.
    closeness = nearest / torch.where(at, torch.ones_like(distances), distances)
    closeness = torch.where(at, torch.ones_like(distances), closeness)
    return closeness / closeness.sum()


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
    total = share.sum(dim=0)
    seen = total > 0
    share = torch.where(seen, share, weights) / torch.where(seen, total, torch.ones_like(total))
    mixed_alpha = torch.where(seen, (share * alpha).sum(dim=0), 0)
    mixed_depth = torch.where(seen, (share * depth).sum(dim=0), 0)
    return Rendering((share[:, None] * color).sum(dim=0), mixed_alpha, mixed_depth)
