"""How much each input view counts at a camera position.

Source: PanSplat, section 3.4 (deferred blending), for any number of views; docs/rendering.md, section 7.
"""

import torch
from jaxtyping import Float
from torch import Tensor


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
