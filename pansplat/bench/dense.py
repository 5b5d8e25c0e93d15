"""A dense panorama renderer: every pixel against every Gaussian. The plain way to write one in torch, as a peer.

Source: docs/rendering.md, sections 3 and 4, without tiles or boxes: its work is pixels times Gaussians.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.constants import ALPHA_CUT, FILTER_VARIANCE, MAX_ALPHA, NEAR
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions
from pansplat.rendering.projection import project_gaussians

_SIDE = 16  # pixels of a block: close together, so that float32 keeps their differences


def render_dense(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], height: int, *, near: float = NEAR
) -> Float[Tensor, "channel height width"]:
    """A panorama on black by the exact kernel, radial order and angular filter; differentiable.

    Args:
        gaussians: all finite.
        cam2world: rigid, metres.
        height: of the panorama, pixels.
        near: Gaussians whose mean is nearer are left out, metres.
    """
    pose = cam2world.double()
    radius = torch.linalg.vector_norm(gaussians.means.detach().double() - pose[:3, 3], dim=1)
    index = torch.argsort(radius, stable=True)
    gaussians = gaussians.select(index[radius[index] >= near])
    variance = FILTER_VARIANCE["angular"] * (math.pi / height) ** 2
    seen = project_gaussians(gaussians, None, pose, filter_variance=variance, compensate=True, exact=True)
    splats = seen.rows, seen.radial_variance, seen.peak, seen.values[:, :-1]
    directions = pixel_directions(height, 2 * height, dtype=torch.float64)
    rows = []
    for strip in directions.split(_SIDE):
        blocks = []
        for block in strip.split(_SIDE, dim=1):
            arguments = (*splats, seen.direction, block.reshape(-1, 3))
            sums = (
                checkpoint(_block, *arguments, use_reentrant=False) if torch.is_grad_enabled() else _block(*arguments)
            )
            blocks.append(sums.reshape(*block.shape[:2], -1))
        rows.append(torch.cat(blocks, dim=1))
    return torch.cat(rows).permute(2, 0, 1)


def _block(
    forms: Float[Tensor, "n 3 3"],
    along: Float[Tensor, "n"],
    peak: Float[Tensor, "n"],
    values: Float[Tensor, "n channel"],
    direction: Float[Tensor, "n 3"],
    pixels: Float[Tensor, "pixel 3"],
) -> Float[Tensor, "pixel channel"]:
    """Colours of a block of pixels; the Gaussians come front to back."""
    centre = pixels.mean(dim=0)
    offsets = (pixels - centre).to(forms.dtype)
    constant = -(forms @ (direction - centre).to(forms.dtype)[:, :, None])
    a, b, front = (forms @ offsets.T + constant).unbind(1)
    front = 1 + front
    square = a * a + b * b
    q = square / (front.clamp_min(1e-3).square() + along[:, None] * square)
    alpha = (peak[:, None] * torch.exp(-0.5 * q)).clamp_max(MAX_ALPHA)
    alpha = torch.where((front > 0) & (alpha >= ALPHA_CUT), alpha, 0)
    behind = torch.cumprod(1 - alpha, dim=0)
    weights = alpha * torch.cat((torch.ones_like(behind[:1]), behind[:-1]))
    return weights.T @ values
