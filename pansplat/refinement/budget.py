"""Fewer Gaussians for the same pictures: those that contribute nothing are dropped, similar neighbours are merged.

The contribution of a Gaussian is its blending weight, summed over the solid angle of an image and divided by the
sphere's. If a set of Gaussians is removed, the mean absolute change of that image is at most the sum of their
contributions, for colours in [0, 1] and to first order in the weights.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import row_weights
from pansplat.geometry.morton import morton_codes
from pansplat.geometry.pose import interpolate_poses, nearest_views, quats_from_rotations
from pansplat.rendering.weights import sum_weights

DROP_ERROR = 5e-3  # largest mean absolute change of an image's colours by all Gaussians that are dropped
MAX_OTHERS = 3  # cameras of other views that a view is rasterised at, here and in the steps of a refinement
_MAX_MERGED_OPACITY = 0.99  # a merged Gaussian with more opacity becomes wider (docs/refinement.md)
_DIRECTION_BITS = 15  # a half axis of the cells of directions, on a Z-order curve, has 2^15 steps
_NEIGHBOURS = 8  # Gaussians before, and as many behind, along the curve of directions that one may merge with
_BASE_COST = 0.008  # cost of a merger between equal Gaussians, as a difference of colours
_MERGED_SHARE = 0.5  # share of a round's pairs that is merged (docs/what_was_tried.md)


@torch.inference_mode(False)  # contributions are gradients
def measure_contributions(scene: Scene, size: tuple[int, int]) -> Float[Tensor, "n"]:
    """Largest contribution of each Gaussian to the images of its view, in joint drawing to those of all views.

    The images are at the view's own camera, at the nearest other ones, and halfway to them.
    """
    size = (max(size[0] // 2, 1), max(size[1] // 2, 1))  # this takes a quarter of the time; the filter conserves energy
    gaussians, poses = scene.gaussians, scene.cam2world
    largest = torch.zeros_like(gaussians.opacities)
    area = row_weights(size[0]).to(largest)[:, None].expand(size)
    area = area / (row_weights(size[0]).sum() * size[1])
    near = [nearest_views(poses, view, MAX_OTHERS) for view in range(len(poses))]

    def halfway(a: int, b: int) -> Tensor:
        return interpolate_poses(poses[a], poses[b], 0.5)

    if scene.joint:
        middles = {(min(view, other), max(view, other)) for view, others in enumerate(near) for other in others}
        groups = [(torch.ones_like(largest, dtype=torch.bool), [*poses, *(halfway(*pair) for pair in sorted(middles))])]
    else:
        groups = [
            (
                gaussians.views == view,
                [poses[view], *(poses[other] for other in near[view]), *(halfway(view, other) for other in near[view])],
            )
            for view in torch.unique(gaussians.views).tolist()
        ]
    for chosen, cameras in groups:
        index = chosen.nonzero()[:, 0]
        part = gaussians.select(index)
        for camera in cameras:
            contributions = sum_weights(part, camera, area)
            largest[index] = torch.maximum(largest[index], contributions)
    return largest


def drop_unseen(scene: Scene, size: tuple[int, int], error: float = DROP_ERROR) -> Scene:
    """Drop the Gaussians of least contribution, whose sum of contributions is at most `error`.

    Args:
        size: height and width of the images that the contributions are measured in, pixels.
    """
    contributions = measure_contributions(scene, size)
    order = contributions.argsort(stable=True)
    kept = torch.ones_like(contributions, dtype=torch.bool)
    kept[order[contributions[order].double().cumsum(0) <= error]] = False
    return dataclasses.replace(scene, gaussians=scene.gaussians.select(kept))


def merge_to(scene: Scene, size: tuple[int, int], count: int) -> Scene:
    """Merge pairs of similar neighbours until at most `count` Gaussians remain.

    Pairs are of one view and level. In each round, the pairs that change the images least are merged. If no pairs are
    left, the Gaussians of least contribution are dropped.

    Args:
        size: height and width of the images that the contributions are measured in, pixels.
    """
    contributions = measure_contributions(scene, size)
    cameras = scene.cam2world[:, :3, 3]
    parts = _Parts.of(scene.gaussians)
    for seed in itertools.count():
        if (surplus := len(contributions) - count) <= 0:
            break
        first, second = _find_mutual_neighbours(parts.gaussians, cameras, seed)
        if not len(first):
            best = contributions.argsort(descending=True, stable=True)[:count]
            parts = parts.select(best)
            break
        cost = _merge_cost(parts.gaussians, contributions, first, second)
        chosen = cost.argsort(stable=True)[: min(surplus, math.ceil(_MERGED_SHARE * len(cost)))]
        first, second = first[chosen], second[chosen]
        is_kept = torch.ones_like(contributions, dtype=torch.bool)
        is_kept[first] = is_kept[second] = False
        kept = is_kept.nonzero()[:, 0]
        contributions = torch.cat((contributions[kept], contributions[first] + contributions[second]))
        parts = _Parts.cat(parts.select(kept), _merge_pairs(parts.select(first), parts.select(second)))
    gaussians = parts.decompose()
    order = _labels(gaussians, len(cameras)).argsort(stable=True)
    return dataclasses.replace(scene, gaussians=gaussians.select(order))


@dataclasses.dataclass(frozen=True)
class _Parts:
    """Gaussians between two rounds of mergers.

    Attributes:
        gaussians: scales and rotations of merged ones are those of their first part.
        covariances: of all, square metres.
        is_merged: whether a Gaussian has more than one part.
    """

    gaussians: Gaussians
    covariances: Float[Tensor, "n 3 3"]
    is_merged: Bool[Tensor, "n"]

    @classmethod
    def of(cls, gaussians: Gaussians) -> _Parts:
        covariances = gaussians.to(dtype=torch.float64).covariances
        return cls(gaussians, covariances, torch.zeros_like(gaussians.opacities, dtype=torch.bool))

    @classmethod
    def cat(cls, first: _Parts, second: _Parts) -> _Parts:
        return cls(
            Gaussians.cat([first.gaussians, second.gaussians]),
            torch.cat((first.covariances, second.covariances)),
            torch.cat((first.is_merged, second.is_merged)),
        )

    def select(self, index: Integer[Tensor, "m"]) -> _Parts:
        return _Parts(self.gaussians.select(index), self.covariances[index], self.is_merged[index])

    def decompose(self) -> Gaussians:
        """The Gaussians, with scales and rotations of the merged ones."""
        merged = self.is_merged.nonzero()[:, 0]
        values, axes = torch.linalg.eigh(self.covariances[merged])
        axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
        scales, quats = self.gaussians.scales.clone(), self.gaussians.quats.clone()
        scales[merged] = values.clamp_min(0).sqrt().to(scales)
        quats[merged] = quats_from_rotations(axes).to(quats)
        return dataclasses.replace(self.gaussians, scales=scales, quats=quats)


def _labels(gaussians: Gaussians, num_views: int) -> Integer[Tensor, "n"]:
    """A number for each combination of level and view."""
    return gaussians.levels.long() * num_views + gaussians.views.long()


def _find_mutual_neighbours(
    gaussians: Gaussians, cameras: Float[Tensor, "view 3"], seed: int
) -> tuple[Integer[Tensor, "pair"], Integer[Tensor, "pair"]]:
    """Pairs of one view and level that are each other's nearest neighbour, by direction and log-distance.

    Neighbours are searched among the next Gaussians along a Z-order curve through the directions. The seed turns the
    curve, so that those it separates meet along another one.
    """
    centers = cameras.to(device=gaussians.means.device, dtype=torch.float64)
    offsets = gaussians.means.double() - centers[gaussians.views.long().to(centers.device)]
    distances = offsets.norm(dim=1, keepdim=True).clamp_min(1e-9)
    labels = _labels(gaussians, len(cameras)).cpu().numpy()
    features = torch.cat((offsets / distances, distances.log()), dim=1).cpu().numpy().astype(np.float32)
    turn = scipy.spatial.transform.Rotation.random(random_state=seed).as_matrix().astype(np.float32)
    cells = np.clip((features[:, :3] @ turn + 1) * (1 << _DIRECTION_BITS), 0, (2 << _DIRECTION_BITS) - 1)
    order = np.lexsort((morton_codes(cells.astype(np.int64)), labels))
    features, labels = features[order], labels[order]
    least, nearest = np.full(len(order), np.inf, np.float32), np.full(len(order), -1)
    for step in range(1, min(_NEIGHBOURS, len(order) - 1) + 1):
        square = np.square(features[step:] - features[:-step]).sum(axis=1)
        square[labels[step:] != labels[:-step]] = np.inf
        for here, there in ((slice(None, -step), step), (slice(step, None), -step)):
            index = np.flatnonzero(square < least[here]) + (here.start or 0)
            least[index], nearest[index] = square[index - max(-there, 0)], index + there
    index = np.arange(len(order))
    is_pair = (nearest > index) & (nearest[nearest] == index)
    first, second = (torch.from_numpy(order[found[is_pair]]) for found in (index, nearest))
    return first.to(gaussians.means.device), second.to(gaussians.means.device)


def _merge_cost(gaussians: Gaussians, contributions: Tensor, first: Tensor, second: Tensor) -> Float[Tensor, "pair"]:
    """Estimated mean absolute change of an image by each merger."""
    colors = SH_0 * gaussians.harmonics[:, 0]
    difference = (colors[first] - colors[second]).abs().mean(1)
    a, b = contributions[first], contributions[second]
    shared = 2 * a * b / (a + b).clamp_min(torch.finfo(a.dtype).tiny)
    return shared * difference + (a + b) * _BASE_COST


def _merge_pairs(first: _Parts, second: _Parts) -> _Parts:
    """Gaussians with the mean and covariance of each pair, and its integral of opacity below the limit of opacity."""
    masses = [part.gaussians.opacities.double() * _area(part.covariances) for part in (first, second)]
    total = (masses[0] + masses[1]).clamp_min(1e-30)
    share = (masses[0] / total)[:, None]

    def average(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
        return weight * a.double() + (1 - weight) * b.double()

    a, b = first.gaussians, second.gaussians
    spread = (a.means.double() - b.means.double()) * (share * (1 - share)).sqrt()
    covariances = average(first.covariances, second.covariances, share[:, :, None])
    covariances = covariances + spread[:, :, None] * spread[:, None, :]
    opacities = total / _area(covariances)
    # Pairs that overlap have more opacity than fits into their covariance, which alone would leave gaps. Half of the
    # surplus, in logarithms, becomes area (docs/refinement.md).
    covariances = covariances * (opacities / _MAX_MERGED_OPACITY).clamp_min(1).sqrt()[:, None, None]
    merged = dataclasses.replace(
        a,
        means=average(a.means, b.means, share).float(),
        opacities=opacities.clamp_max(_MAX_MERGED_OPACITY).float(),
        harmonics=average(a.harmonics, b.harmonics, share[:, :, None]).float(),
    )
    return _Parts(merged, covariances, torch.ones_like(first.is_merged))


def _area(covariances: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n"]:
    """Product of the two scales of a flat Gaussian: the root of the sum of the principal minors of the covariance."""
    x, y, z = covariances.diagonal(dim1=1, dim2=2).unbind(1)
    xy, xz, yz = covariances[:, 0, 1], covariances[:, 0, 2], covariances[:, 1, 2]
    return (x * y + x * z + y * z - xy * xy - xz * xz - yz * yz).clamp_min(1e-60).sqrt()
