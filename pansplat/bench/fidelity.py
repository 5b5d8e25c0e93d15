"""Errors of a result against its reference: of images, depth maps and sets of tensors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.cubemap import face_of
from pansplat.geometry.equirect import pixel_directions, row_weights

_SEAM_STEP = 2  # pixels; stitching blends over less


@dataclass(frozen=True)
class Fidelity:
    """Errors of an image's colours against the reference.

    Attributes:
        max_error: largest absolute difference.
        psnr_db: peak signal-to-noise ratio of the unclamped colours for a peak of 1; infinite if equal.
        seam_jump: see `seam_jump`; panoramas only.
        energy_error: relative error of the sum of colour over the sphere (over the pixels of a pinhole image).
    """

    max_error: float
    psnr_db: float
    seam_jump: float | None
    energy_error: float


def measure_fidelity(
    image: Float[Tensor, "channel height width"], reference: Float[Tensor, "channel height width"], *, panorama: bool
) -> Fidelity:
    """The errors of an image.

    Args:
        image: colours, any floating type.
        reference: of the same size.
        panorama: whether the images are equirectangular: rows count by their solid angle, and seams are measured.

    Raises:
        ValueError: the sizes differ.
    """
    if image.shape != reference.shape:
        raise ValueError(f"`image` must have the reference's shape {tuple(reference.shape)}, got {tuple(image.shape)}")
    reference = reference.double().cpu()
    error = image.detach().double().cpu() - reference
    weights = row_weights(reference.shape[1])[:, None] if panorama else torch.ones(1, 1, dtype=torch.float64)
    total = float((reference * weights).sum())
    mean_square = float(error.square().mean())
    return Fidelity(
        max_error=float(error.abs().max()),
        psnr_db=-10 * math.log10(mean_square) if mean_square > 0 else math.inf,
        seam_jump=seam_jump(error) if panorama else None,
        energy_error=float((error * weights).sum()) / total if total else 0.0,
    )


def seam_jump(error: Float[Tensor, "channel height width"]) -> float:
    """Mean change of a panorama's error over two pixels across the cube faces' borders, minus that next to the borders.

    The error is the image minus the reference, so edges of the reference have no effect. 0 for an image without seams.
    """
    height, width = error.shape[-2:]
    faces = face_of(pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)).reshape(height, width)
    across, next_to = [], []
    for dim, length in ((-1, width), (-2, height - _SEAM_STEP)):  # columns wrap, rows do not
        change = (error - error.roll(-_SEAM_STEP, dim)).abs().mean(dim=0).narrow(dim, 0, length)
        border = (faces != faces.roll(-_SEAM_STEP, dim)).narrow(dim, 0, length)
        neighbours = (border.roll(_SEAM_STEP, dim) | border.roll(-_SEAM_STEP, dim)) & ~border
        across.append(change[border])
        next_to.append(change[neighbours])
    jumps, others = torch.cat(across), torch.cat(next_to)
    if not len(jumps) or not len(others):
        return 0.0
    return max(0.0, float(jumps.mean() - others.mean()))


def clamped_psnr(image: Tensor, reference: Tensor) -> float:
    """PSNR of colours clamped to [0, 1], dB; infinite if they are equal."""
    error = (image.double().clamp(0, 1) - reference.double().clamp(0, 1)).pow(2).mean()
    return float(-10 * torch.log10(error))


def relative_depth_errors(depth: Tensor, reference: Tensor) -> tuple[float, float]:
    """Median and largest of |depth - reference| / reference."""
    relative = (depth.double() - reference.double()).abs() / reference.double()
    return float(relative.median()), float(relative.max())


def relative_deviation(result: Mapping[str, Tensor], reference: Mapping[str, Tensor], *, together: bool) -> float:
    """|result - reference| / |reference|, Euclidean norms.

    Args:
        together: of all tensors as one vector; else the largest value among the tensors.

    Raises:
        ValueError: the names differ.
    """
    if result.keys() != reference.keys():
        raise ValueError(f"`result` must hold {sorted(reference)}, got {sorted(result)}")
    errors = {name: float((result[name].double() - reference[name].double()).norm()) for name in reference}
    norms = {name: float(reference[name].double().norm()) for name in reference}
    if together:
        return math.hypot(*errors.values()) / max(math.hypot(*norms.values()), 1e-300)
    return max(errors[name] / max(norms[name], 1e-300) for name in reference)
