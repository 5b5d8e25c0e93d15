"""The baseline that knows no geometry: inputs turned into the target's orientation, faded into each other."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.blending import blend_weights
from pansplat.geometry.equirect import rotate_equirect


def cross_fade(
    images: Float[Tensor, "view 3 height width"],
    cam2world: Float[Tensor, "view 4 4"],
    target: Float[Tensor, "4 4"],
) -> Float[Tensor, "3 height width"]:
    """The panorama at pose `target` as if everything were far away: inputs weighted by nearness."""
    poses, target = cam2world.double(), target.double()
    weights = blend_weights(target[:3, 3], poses[:, :3, 3]).to(images)
    faded = torch.zeros_like(images[0])
    for image, pose, weight in zip(images, poses, weights, strict=True):
        faded += weight * rotate_equirect(image, pose[:3, :3].T @ target[:3, :3])
    return faded
