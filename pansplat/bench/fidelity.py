"""How far a panorama is from the true one: largest and mean error, seams, energy.

Source: issue 3; RASTER.md ("Accuracy") for why each is looked at.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.cubemap import face_of
from pansplat.geometry.equirect import pixel_directions, row_weights

_STEP = 2  # pixels: stitching blends over less than that


@dataclass(frozen=True)
class Fidelity:
    """Errors of a picture's colours against the truth.

    Attributes:
        max_error: largest absolute difference.
        psnr_db: peak signal-to-noise ratio of the unclamped colours for a peak of 1; infinite when equal.
        seam_jump: how much more the error changes across the cube faces' borders than beside them; panoramas only.
        energy_error: relative error of the picture's sum of colour over the sphere (over pixels for a pinhole).
    """

    max_error: float
    psnr_db: float
    seam_jump: float | None
    energy_error: float


def fidelity(
    picture: Float[Tensor, "channel height width"],
    truth: Float[Tensor, "channel height width"],
    *,
    panorama: bool,
) -> Fidelity:
    """The errors of a picture.

    Args:
        picture: colours, any floating type.
        truth: of the same size.
        panorama: equirectangular, so that there can be seams, and rows count by their solid angle.

    Raises:
        ValueError: the sizes differ.
    """
    if picture.shape != truth.shape:
        raise ValueError(f"`picture` must have the truth's shape {tuple(truth.shape)}, got {tuple(picture.shape)}")
    truth = truth.double().cpu()
    error = picture.detach().double().cpu() - truth
    weights = row_weights(truth.shape[1])[:, None] if panorama else torch.ones(1, 1, dtype=torch.float64)
    total = float((truth * weights).sum())
    mean_square = float(error.square().mean())
    return Fidelity(
        max_error=float(error.abs().max()),
        psnr_db=-10 * math.log10(mean_square) if mean_square > 0 else math.inf,
        seam_jump=seam_jump(error) if panorama else None,
        energy_error=float((error * weights).sum()) / total if total else 0.0,
    )


def seam_jump(error: Float[Tensor, "channel height width"]) -> float:
    """Mean change of a panorama's error over two pixels across the cube faces' borders, less that beside them.

    The error is the picture minus the truth, so the truth's own edges count nothing. 0 for a picture whose error
    knows no borders.
    """
    height, width = error.shape[-2:]
    faces = face_of(pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)).reshape(height, width)
    across, beside = [], []
    for dim, length in ((-1, width), (-2, height - _STEP)):  # columns wrap, rows do not
        change = (error - error.roll(-_STEP, dim)).abs().mean(dim=0).narrow(dim, 0, length)
        border = (faces != faces.roll(-_STEP, dim)).narrow(dim, 0, length)
        near = (border.roll(_STEP, dim) | border.roll(-_STEP, dim)) & ~border
        across.append(change[border])
        beside.append(change[near])
    jumps, plain = torch.cat(across), torch.cat(beside)
    if not len(jumps) or not len(plain):
        return 0.0
    return max(0.0, float(jumps.mean() - plain.mean()))
