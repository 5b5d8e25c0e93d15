"""The quantities that the refinement optimises: Gaussians in terms of their source view, and camera poses."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import invert_pose, multiply_quats, quats_from_rotations, rotations_from_quats

_MIN_REFINED_OPACITY, _MAX_REFINED_OPACITY = 1e-3, 0.999  # the logits of opacities are refined between these
# Largest decrease and increase of the logarithms of distances and scales, of quaternions, and of logits. Without them
# exposures and wrong shapes are explained by veils and specks between the cameras (docs/refinement.md).
_BOUNDS = {"distance": (0.1, 0.1), "scale": (3.0, 0.3), "rotation": (1.0, 1.0), "opacity": (10.0, 0.7)}
_LAYER_FREEDOM = 3.0  # factor of the bounds for Gaussians that are drawn without those of other views
_FREE_PARALLAX = 0.7  # baseline over distance above which bounds fall with its fourth power (docs/refinement.md)
_MIN_SCALE = 1e-9  # smallest scale, relative to the distance
_MIN_DISTANCE = 1e-6  # smallest distance from the source camera, metres
_SPLIT_SHIFT, _SPLIT_SCALE = 0.5, 0.7  # halves of a split Gaussian: shift and scale along its longest axis, in scales


LEARNING_RATES = {
    "distance": 0.008,  # logarithm of the distance from the source camera
    "scale": 0.24,  # logarithms of the scales
    "rotation": 0.04,  # unit quaternions
    "opacity": 0.12,  # logits of the opacities
    "color": 0.02,  # harmonics of degree 0
    "harmonics": 0.002,  # harmonics of higher degree
    "pose": 0.0005,  # the cameras' rotations in radians, and their positions relative to the baseline
}
"""Step sizes of Adam at the start of a refinement; they fall to a fraction along a cosine."""


class ViewParameters:
    """The Gaussians of one source view, free along its rays.

    A Gaussian keeps its direction from the source camera. Its scales are proportional to its distance, so that a change
    of distance keeps its size in the source view.

    Args:
        gaussians: the view's Gaussians; at least one.
        camera: position of the source camera, metres.
        baseline: distance of the nearest other camera whose Gaussians are drawn together with them, metres; 0 without.

    Attributes:
        tensors: by their name in `NAMES`: the change of the logarithm of the distance, logarithms of the scales,
            quaternions, logits of the opacities, harmonics of degree 0, and those of higher degrees.
    """

    NAMES = ("distance", "scale", "rotation", "opacity", "color", "harmonics")

    def __init__(self, gaussians: Gaussians, camera: Float[Tensor, "3"], baseline: float = 0.0) -> None:
        gaussians = gaussians.to(dtype=torch.float32)
        self._levels, self._views = gaussians.levels, gaussians.views
        self._camera = camera.to(gaussians.means)
        self._offsets = gaussians.means - self._camera
        distances = self._offsets.norm(dim=1).clamp_min(_MIN_DISTANCE)
        scales = torch.maximum(gaussians.scales, _MIN_SCALE * distances[:, None])
        self._freedom = (_FREE_PARALLAX / (baseline or math.inf) * distances).clamp_max(1) ** 4
        self._freedom += 0 if baseline else _LAYER_FREEDOM
        quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
        opacities = gaussians.opacities.clamp(_MIN_REFINED_OPACITY, _MAX_REFINED_OPACITY)
        color, harmonics = gaussians.harmonics.split((1, gaussians.harmonics.shape[1] - 1), dim=1)
        values = (torch.zeros_like(distances), scales.log(), quats, opacities.logit(), color, harmonics)
        self._given = {name: value.detach() for name, value in zip(self.NAMES, values, strict=True)}
        self.tensors = {name: value.clone().requires_grad_() for name, value in self._given.items()}

    def __len__(self) -> int:
        return len(self._levels)

    def build(self) -> Gaussians:
        """The Gaussians, differentiable in `tensors`."""
        distance, scale, rotation, opacity, color, harmonics = (self.tensors[name] for name in self.NAMES)
        factor = distance.exp()[:, None]
        return Gaussians(
            means=self._camera + self._offsets * factor,
            scales=scale.exp() * factor,
            quats=rotation,
            opacities=opacity.sigmoid(),
            harmonics=torch.cat((color, harmonics), dim=1) if harmonics.shape[1] else color,
            levels=self._levels,
            views=self._views,
        )

    @torch.no_grad()
    def split(self, is_split: Bool[Tensor, "n"]) -> None:
        """Replace Gaussians by two halves along their longest axis, in place and in order. `tensors` are new ones.

        The halves keep the opacity. The variance of both together along that axis is 0.74 of the Gaussian's, because
        detail is missing where a Gaussian is split.
        """
        index = torch.arange(len(is_split), device=is_split.device).repeat_interleave(1 + is_split.long())
        halves = is_split[index].nonzero()[:, 0]
        self.tensors = {name: tensor.detach()[index].requires_grad_() for name, tensor in self.tensors.items()}
        self._levels, self._views = self._levels[index], self._views[index]
        self._given = {name: tensor[index] for name, tensor in self._given.items()}
        self._offsets, self._freedom = self._offsets[index], self._freedom[index]
        longest, axis = self.tensors["scale"][halves].max(dim=1)
        axes = rotations_from_quats(self.tensors["rotation"][halves])
        shifts = _SPLIT_SHIFT * longest.exp()[:, None] * axes.take_along_dim(axis[:, None, None], dim=2)[:, :, 0]
        shifts[1::2] *= -1
        self._offsets[halves] += shifts
        for tensors in (self.tensors, self._given):
            tensors["scale"][halves, axis] += math.log(_SPLIT_SCALE)

    @torch.no_grad()
    def clamp(self) -> None:
        """Keep the tensors in their bounds."""
        for name, (decrease, increase) in _BOUNDS.items():
            given, freedom = self._given[name], self._freedom.reshape(-1, *(1,) * (self._given[name].ndim - 1))
            self.tensors[name].clamp_(given - decrease * freedom, given + increase * freedom)


class CameraParameters:
    """Small corrections of the poses of the photographs.

    A corrected pose is the given pose times the exponential of a twist in camera axes: a rotation vector in radians,
    and a translation relative to the baseline.

    Args:
        cam2world: given poses, metres.
        correct_poses: whether the twists are optimised.
    """

    def __init__(self, cam2world: Float[Tensor, "view 4 4"], *, correct_poses: bool) -> None:
        self.cam2world = cam2world.double().clone()  # a copy, since a tensor of torch.inference_mode has no gradient
        positions = self.cam2world[:, :3, 3]
        self._baseline = float(torch.pdist(positions).max()) if len(positions) > 1 else 0.0
        self.twists = torch.zeros(
            len(cam2world), 6, dtype=torch.float64, device=cam2world.device, requires_grad=correct_poses
        )

    def pose_in_view(self, view: int | None, photograph: int) -> Float[Tensor, "4 4"]:
        """The corrected pose of a photograph relative to the corrected pose of a view, which keeps its given pose.

        Of several views (None) it is the given one: these have no corrections.
        """
        if view is None or view == photograph or not self.twists.requires_grad:
            return self.cam2world[photograph]
        given = self.cam2world[view]
        undo = given @ torch.matrix_exp(-self._generator(view)) @ invert_pose(given)
        return undo @ self.cam2world[photograph] @ torch.matrix_exp(self._generator(photograph))

    @torch.no_grad()
    def corrected_pose(self, view: int) -> Float[Tensor, "4 4"]:
        """The pose of a photograph with its correction."""
        return self.cam2world[view] @ torch.matrix_exp(self._generator(view))

    @torch.no_grad()
    def move(self, gaussians: Gaussians, view: int) -> Gaussians:
        """The Gaussians of a view, moved with the correction of its pose.

        Harmonics above degree 0 are not rotated: corrections are fractions of a degree.
        """
        if not self.twists[view].any():
            return gaussians
        motion = self.corrected_pose(view) @ invert_pose(self.cam2world[view])
        rotation = motion[:3, :3]
        means = gaussians.means.double() @ rotation.T + motion[:3, 3]
        quats = multiply_quats(quats_from_rotations(rotation).expand(len(gaussians), 4), gaussians.quats.double())
        return dataclasses.replace(gaussians, means=means.float(), quats=quats.float())

    def _generator(self, view: int) -> Float[Tensor, "4 4"]:
        """The matrix whose exponential is the correction of a pose."""
        x, y, z, u, v, w = self.twists[view]
        u, v, w, zero = u * self._baseline, v * self._baseline, w * self._baseline, torch.zeros_like(x)
        return torch.stack((zero, -z, y, u, z, zero, -x, v, -y, x, zero, w, zero, zero, zero, zero)).reshape(4, 4)
