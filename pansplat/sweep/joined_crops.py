"""Depth of a panorama from a network of perspective images: overlapping crops, joined on the sphere.

Each crop has an inverse depth of unknown scale and shift. All scales and shifts are solved together: crops agree where
they overlap, and follow the estimate of the depth network as a whole. The joined depth has the edges of the crops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from pansplat.errors import InputError
from pansplat.geometry.equirect import pixel_directions, row_weights, sample_equirect, uv_from_directions
from pansplat.networks.depth_network import DepthEstimate
from pansplat.system.threads import one_thread

_HALF_FIELD_TANGENT = math.tan(math.radians(95) / 2)  # half of the 95 degrees along a crop's shorter side
# Yaw and pitch of the crops, degrees; the last two look straight up and down.
_ANGLES = [(60 * n, 0) for n in range(6)] + [(90 * n + 30, side) for side in (50, -50) for n in range(4)]
_ANGLES += [(0, 90), (0, -90)]
_AGREEMENT = 0.05  # deviation of log-depth that halves the weight of a crop in a pixel
_ESTIMATE_WEIGHT = 0.05  # weight of the estimate, relative to a crop of equal certainty
_DOMINANCE = 3  # exponent of the weights with which crops are blended
_ITERATIONS = 30
_MAX_STEP = 1.0  # largest change of the logarithm of a scale or a shift in one iteration
_DAMPING = 1e-4  # relative to a crop's weight; crops that show one distance only need it
_LEAST_CONTRAST = 1e-4  # mean difference of a crop's values from its smallest, relative to the largest
_MAX_CORRELATION = 0.3  # largest correlation of a crop's values with the estimated distance
_MAX_DEPTH_RATIO = 2.0  # largest joined depth over the largest depth of the estimate


def crop_panorama(
    panorama: Float[Tensor, "3 height width"], size: tuple[int, int]
) -> Float[Tensor, "crop 3 crop_height crop_width"]:
    """The perspective crops, of a size (height, width), that a network is given of a panorama."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in size)
    rays = pixel_rays(torch.stack((columns.expand(size), rows[:, None].expand(size)), dim=-1), size)
    return torch.stack([sample_equirect(panorama, uv_from_directions(rays @ axes.T)) for axes in crop_axes()])


def pixel_rays(pixels: Float[Tensor, "*batch 2"], size: tuple[int, int]) -> Float[Tensor, "*batch 3"]:
    """Rays in a crop's axes of columns and rows; the first pixel's centre is (0, 0)."""
    counts = pixels.new_tensor(size[::-1])
    plane = (pixels * 2 + 1 - counts) / counts * pixels.new_tensor(_extent(size))
    return torch.cat((plane, torch.ones_like(plane[..., :1])), dim=-1)


def join_crops(
    relative: Sequence[Float[Tensor, "crop_height crop_width"]], estimate: DepthEstimate, height: int
) -> Float[Tensor, "height width"]:
    """Log-depth of a panorama, in the unit of the estimate, with the edges of its crops.

    Args:
        relative: inverse depth of the images of `crop_panorama`, along their optical axes, each of another scale and
            shift.
        estimate: estimate of the whole panorama, a batch of one.
        height: height of the result, pixels.
    """
    crops = [_normalise(crop.double()) for crop in relative]
    with one_thread():
        parameters = solve_crops(crops, estimate)
    total, weight = torch.zeros(2, height, 2 * height, dtype=torch.float64)
    for crop, axes, solved in zip(crops, crop_axes(), parameters, strict=True):
        position, forward, window = _project(axes, crop.shape, height)
        window = window**_DOMINANCE
        total += window * _log_depth(_sample(crop, position), forward, solved)
        weight += window
    return (total / weight).clamp_max(float(estimate.log_depth.max()) + math.log(_MAX_DEPTH_RATIO))


def solve_crops(crops: Sequence[Float[Tensor, "h w"]], estimate: DepthEstimate) -> Float[Tensor, "crop 2"]:
    """Logarithms of the scale and of the shift of each crop, whose inverse depth is scale * (value + shift).

    Each pixel of the estimate has an unknown depth. The crops and the estimate deviate from it, with the logarithm of
    a Cauchy distribution as cost, which iterated least squares minimise.

    Raises:
        InputError: the values grow with the depth of the estimate.
    """
    height = estimate.log_depth.shape[-2]
    values, forward, window = _sample_crops(crops, height)
    area = row_weights(height)[:, None].expand(height, 2 * height).flatten()
    known, scale = estimate.log_depth[0].double().flatten(), estimate.log_scale[0].double().exp().flatten()
    nearness = values - (window * values).sum(dim=1, keepdim=True) / window.sum(dim=1, keepdim=True)
    distance = (known - known.mean()).expand_as(values)
    products = [(window * area * a * b).sum() for a, b in ((nearness, distance), (nearness, nearness), (distance,) * 2)]
    if products[0] > _MAX_CORRELATION * (products[1] * products[2]).sqrt():
        raise InputError(
            "the depth network: needed relative inverse depth, which is large near the camera, got values that grow "
            "with the distance; choose a network of inverse depth (docs/depth_network.md)."
        )
    window = window * area / _AGREEMENT**2
    certainty = _ESTIMATE_WEIGHT * area / scale**2
    solved = torch.zeros(len(crops), 2, dtype=torch.float64)
    mean = known
    for _ in range(_ITERATIONS):
        depth = _log_depth(values, forward, solved.T[..., None])
        weights = window / (1 + ((depth - mean) / _AGREEMENT) ** 2)
        weight = certainty / (1 + ((known - mean) / scale) ** 2)
        total = weights.sum(dim=0) + weight
        mean = (weight * known + (weights * depth).sum(dim=0)) / total
        # Derivatives of log-depth by both logarithms, as one row for each crop and logarithm.
        shift = solved[:, 1:].exp()
        rows = -torch.stack((torch.ones_like(values), shift / (values + shift)), dim=1)
        pull = torch.einsum("cip,cp->ci", rows, weights * (depth - mean)).flatten()
        own = torch.einsum("cip,cjp,cp->cij", rows, rows, weights)
        own += _DAMPING * weights.sum(dim=1)[:, None, None] * torch.eye(2)
        shared = (rows * (weights / total.sqrt())[:, None]).flatten(0, 1)
        solved -= (
            torch.linalg.solve(torch.block_diag(*own) - shared @ shared.T, pull)
            .clamp(-_MAX_STEP, _MAX_STEP)
            .unflatten(0, (-1, 2))
        )
    return solved


def crop_axes() -> Float[Tensor, "crop 3 3"]:
    """Axes of the crops' cameras in those of the panorama (columns: right, down, forward)."""
    yaw, pitch = torch.tensor(_ANGLES, dtype=torch.float64).deg2rad().T
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    turn = torch.stack((yaw.cos(), zero, yaw.sin(), zero, one, zero, -yaw.sin(), zero, yaw.cos()), dim=-1)
    rise = torch.stack((one, zero, zero, zero, pitch.cos(), -pitch.sin(), zero, pitch.sin(), pitch.cos()), dim=-1)
    return turn.unflatten(-1, (3, 3)) @ rise.unflatten(-1, (3, 3))


def _normalise(crop: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Values from 0, with a mean of 1; differences that are small beside the values are rounding errors."""
    above = crop - crop.min()
    return above / torch.maximum(above.mean(), _LEAST_CONTRAST * crop.abs().max()).clamp_min(1e-12)


def _extent(size: Sequence[int]) -> tuple[float, float]:
    """Tangents of half of the field of view, along width and height, of a crop of a size (height, width)."""
    return _HALF_FIELD_TANGENT * size[1] / min(size), _HALF_FIELD_TANGENT * size[0] / min(size)


def _project(axes: Tensor, size: Sequence[int], height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions in [-1, 1] of a panorama's pixels (h, w) in a crop, cosines to its optical axis, and weights.

    A weight is 1 at the crop's centre and 0 at its borders and outside.
    """
    x, y, forward = (pixel_directions(height, 2 * height, dtype=torch.float64) @ axes).unbind(-1)
    forward = forward.clamp_min(1e-3)
    position = torch.stack((x, y), dim=-1) / forward[..., None] / torch.tensor(_extent(size), dtype=torch.float64)
    return position, forward, (1 - position.square()).clamp_min(0).prod(dim=-1)


def _sample(crop: Float[Tensor, "h w"], position: Float[Tensor, "height width 2"]) -> Float[Tensor, "height width"]:
    maps, grid = crop[None, None].double(), position[None]
    return grid_sample(maps, grid, mode="bilinear", padding_mode="border", align_corners=False)[0, 0]


def _sample_crops(crops: Sequence[Tensor], height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Values, cosines and weights (crop, pixel) of all crops in a small panorama, averaged over its pixels."""
    found = []
    for crop, axes in zip(crops, crop_axes(), strict=True):
        position, forward, window = _project(axes, crop.shape, height)
        factor = 2 * _HALF_FIELD_TANGENT * height / math.pi / min(crop.shape)
        small = crop if factor > 1 else interpolate(crop[None, None].double(), scale_factor=factor, mode="area")[0, 0]
        found.append(torch.stack([each.flatten() for each in (_sample(small, position), forward, window)]))
    values, forward, window = torch.stack(found, dim=1)
    return values, forward, window


def _log_depth(values: Tensor, forward: Tensor, solved: Tensor) -> Tensor:
    """Logarithm of radial depth, of the normalised values of crops and the logarithms of scale and shift."""
    return -solved[0] - (values + solved[1].exp()).log() - forward.log()
