"""From the numbers that a network predicts for a point to a Gaussian in the world.

Source: PanSplat, section 3.3; OFFICIAL.md, section 9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.gaussians.harmonics import rotation_matrices
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import directions_from_uv
from pansplat.geometry.pose import multiply_quats, quats_from_rotations
from pansplat.model.layers import Compat

_SCALE_UNIT = 0.2  # a scale of 1 spans this part of a map pixel
# The network's colours are in harmonics whose polar axis is y, in the cyclic order y, z, x of the 3DGS axes: with
# these camera axes in rows, its k-th function along d is the 3DGS one along _POLAR_Y d.
_POLAR_Y = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class AdapterConfig:
    """Ranges of what the network may predict; shipped weights fix all of it."""

    degree: int = 4
    """Degree of the spherical harmonics."""
    min_scale: float = 0.5
    """Smallest standard deviation, in fifths of a map pixel's angle."""
    max_scale: float = 15.0
    """Largest standard deviation, in fifths of a map pixel's angle."""

    @property
    def num_parameters(self) -> int:
        """Numbers a Gaussian: 3 scale, 4 rotation, 3 colours of (degree + 1)^2 harmonics."""
        return 7 + 3 * (self.degree + 1) ** 2


def adapt(
    parameters: Float[Tensor, "n parameter"],
    uv: Float[Tensor, "n 2"],
    depths: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    cam2world: Float[Tensor, "4 4"],
    *,
    map_height: int,
    colors: Float[Tensor, "n 3"] | None,
    level: int,
    view: int,
    config: AdapterConfig,
    compat: Compat,
) -> Gaussians:
    """Gaussians of one view and level.

    Args:
        parameters: raw [3 scale | 4 rotation xyzw, camera axes | 3 x (degree + 1)^2 harmonics, colour by colour].
        uv: where on the panorama, normalised.
        depths: radial distance from the camera, metres.
        opacities: in [0, 1].
        map_height: rows of the level's map; a scale is a multiple of its pixel's angle times the depth.
        colors: RGB in [0, 1] that the harmonics are added to, or None where a level adds to no colour.
        level, view: labels of the Gaussians.
    """
    camera = cam2world[:3, :3].double()
    directions = directions_from_uv(uv) @ camera.to(uv).T
    scale_part, rotation_part, harmonics_part = parameters.split((3, 4, config.num_parameters - 7), dim=-1)
    scales = config.min_scale + (config.max_scale - config.min_scale) * torch.sigmoid(scale_part)
    pixel_radians = math.pi / map_height
    # Divided as the original divides: a quaternion of length 0 is not made one of length 1.
    own = rotation_part.roll(1, dims=-1)  # xyzw to wxyz
    own = own / (own.norm(dim=-1, keepdim=True) + 1e-8)
    turn = quats_from_rotations(camera).to(own)
    return Gaussians(
        means=cam2world[:3, 3].to(depths) + depths[:, None] * directions,
        scales=scales * (_SCALE_UNIT * pixel_radians) * depths[:, None],
        quats=multiply_quats(turn.expand_as(own), own),
        opacities=opacities,
        harmonics=_world_harmonics(harmonics_part, colors, camera, config.degree, compat),
        levels=torch.full(depths.shape, level, dtype=torch.uint8, device=depths.device),
        views=torch.full(depths.shape, view, dtype=torch.uint8, device=depths.device),
    )


def world_harmonics_rotation(rotation: Float[Tensor, "3 3"], compat: Compat) -> Float[Tensor, "3 3"]:
    """Rotation from the axes in which the network's colours are 3DGS harmonics to the world's.

    The original turns colours by the camera's rotation with x and z reversed, which is right only for a turn
    about y (OFFICIAL.md, trap T3). Its rasteriser moreover reads z for y in coefficient 14 and leaves out degree 4
    (trap T4); that is the drawing's business, not the prediction's.
    """
    if compat == "official":
        reverse = torch.tensor((-1.0, 1.0, -1.0)).to(rotation)
        rotation = reverse[:, None] * rotation * reverse
    return rotation @ torch.tensor(_POLAR_Y).to(rotation).T


def _world_harmonics(
    raw: Float[Tensor, "n parameter"],
    colors: Float[Tensor, "n 3"] | None,
    camera: Float[Tensor, "3 3"],
    degree: int,
    compat: Compat,
) -> Float[Tensor, "n k 3"]:
    """Harmonics in the world from raw ones in camera axes: damped by degree, on a base colour."""
    harmonics = raw.unflatten(-1, (3, -1)) * _damping(degree).to(raw)
    if colors is not None:
        base = 2 * (colors - 0.5)
        harmonics = torch.cat((harmonics[..., :1] + base[..., None], harmonics[..., 1:]), dim=-1)
    turn = rotation_matrices(world_harmonics_rotation(camera, compat), degree).to(raw)
    # One product of two matrices: of strided harmonics, torch would make one for each Gaussian.
    turned = harmonics.reshape(-1, harmonics.shape[-1]) @ turn.T
    return turned.view(harmonics.shape).transpose(-1, -2)


def _damping(degree: int) -> Float[Tensor, "k"]:
    """Factor of each raw coefficient: higher degrees start close to nothing."""
    factors = [1.0] + [0.1 * 0.25**band for band in range(1, degree + 1) for _ in range(2 * band + 1)]
    return torch.tensor(factors, dtype=torch.float64)
