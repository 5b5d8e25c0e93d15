"""How close predicted depth is to the true one.

Source: PanSplat, section 4; OFFICIAL.md, section 13: the inputs' finest depth, made as large as the picture, compared
where the true depth is within the range of the search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class DepthErrors:
    """Errors of one scene, all its views together; NaN where no pixel has a true depth.

    Attributes:
        abs_rel: mean of |error| / truth.
        sq_rel: mean of error^2 / truth, metres.
        rmse: root of the mean of error^2, metres.
    """

    abs_rel: float
    sq_rel: float
    rmse: float


def depth_errors(
    depth: Float[Tensor, "view h w"], true_depth: Float[Tensor, "view height width"], near: float, far: float
) -> DepthErrors:
    """Errors over the pixels whose true depth is strictly between `near` and `far`.

    Args:
        depth: radial, metres; made as large as the truth bilinearly, pixel centres at half-integers, not wrapping.
        true_depth: radial, metres, 0 where unknown.
    """
    size = true_depth.shape[-2:]
    large = functional.interpolate(depth[:, None].double(), size, mode="bilinear", align_corners=False)[:, 0]
    known = (true_depth > near) & (true_depth < far)
    if not known.any():
        return DepthErrors(math.nan, math.nan, math.nan)
    truth = true_depth[known].double()
    error = large.to(truth)[known] - truth
    return DepthErrors(
        abs_rel=float((error.abs() / truth).mean()),
        sq_rel=float((error.square() / truth).mean()),
        rmse=math.sqrt(float(error.square().mean())),
    )
