"""Fewer Gaussians for the same pictures: those that contribute nothing are dropped, similar neighbours are merged.

The contribution of a Gaussian is its blending weight, summed over the solid angle of an image and divided by the
sphere's. If a set of Gaussians is removed, the mean absolute change of that image is at most the sum of their
contributions, for colours in [0, 1] and to first order in the weights.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from jaxtyping import Float, Integer
from scipy.spatial import cKDTree
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0
from pansplat.gaussians.scene import Gaussians, Scene
from pansplat.geometry.equirect import row_weights
from pansplat.geometry.pose import interpolate_poses, nearest_views, quats_from_rotations
from pansplat.rendering import rasterize

DROP_ERROR = 5e-3  # largest mean absolute change of an image by all Gaussians that are dropped
MAX_OTHERS = 3  # cameras of other views that a view is rasterised at
_MAX_OPACITY = 0.99
_LABEL_DISTANCE = 10.0  # between Gaussians of different views or levels; larger than any other distance
_BASE_COST = 0.002  # cost of a merger between equal Gaussians, as a difference of colours


def measure_contributions(scene: Scene, size: tuple[int, int]) -> Float[Tensor, "n"]:
    """Largest contribution of each Gaussian to the images of its view.

    The images are at its own camera, at the nearest other ones, and halfway to them.
    """
    size = (max(size[0] // 2, 1), max(size[1] // 2, 1))  # a quarter of the time; the filter conserves energy
    gaussians = scene.gaussians
    largest = torch.zeros_like(gaussians.opacities)
    area = row_weights(size[0]).to(largest)[:, None] / (row_weights(size[0]).sum() * size[1])
    for view in torch.unique(gaussians.views).tolist():
        index = (gaussians.views == view).nonzero()[:, 0]
        part, own = gaussians.select(index), scene.cam2world[view]
        others = [scene.cam2world[other] for other in nearest_views(scene.cam2world, view, MAX_OTHERS)]
        for pose in (own, *others, *(interpolate_poses(own, other, 0.5) for other in others)):
            # A grey image of one channel: its gradient in the colours is the sum of the weights.
            colors = torch.zeros(len(part), 1, 1, dtype=largest.dtype, device=largest.device, requires_grad=True)
            image = rasterize(dataclasses.replace(part, harmonics=colors), pose, size=size).color
            (image * area).sum().backward()
            assert colors.grad is not None
            largest[index] = torch.maximum(largest[index], colors.grad[:, 0, 0] / SH_0)
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

    Pairs are of one view and level. The pairs that change the images least are merged first. If no pairs are left, the
    Gaussians of least contribution are dropped.

    Args:
        size: height and width of the images that the contributions are measured in, pixels.
    """
    gaussians, contributions = scene.gaussians, measure_contributions(scene, size)
    cameras = scene.cam2world[:, :3, 3]
    while (surplus := len(gaussians) - count) > 0:
        first, second = _find_mutual_neighbours(gaussians, cameras)
        if not len(first):
            best = contributions.argsort(descending=True, stable=True)[:count]
            gaussians, contributions = gaussians.select(best), contributions[best]
            break
        chosen = _merge_cost(gaussians, contributions, first, second).argsort(stable=True)[:surplus]
        first, second = first[chosen], second[chosen]
        kept = torch.ones_like(contributions, dtype=torch.bool)
        kept[first] = kept[second] = False
        merged = _merge_pairs(gaussians.select(first), gaussians.select(second))
        contributions = torch.cat((contributions[kept], contributions[first] + contributions[second]))
        gaussians = Gaussians.cat([gaussians.select(kept), merged])
    order = _labels(gaussians, len(cameras)).argsort(stable=True)
    return dataclasses.replace(scene, gaussians=gaussians.select(order))


def _labels(gaussians: Gaussians, num_views: int) -> Integer[Tensor, "n"]:
    """A number for each combination of level and view."""
    return gaussians.levels.long() * num_views + gaussians.views.long()


def _find_mutual_neighbours(
    gaussians: Gaussians, cameras: Float[Tensor, "view 3"]
) -> tuple[Integer[Tensor, "pair"], Integer[Tensor, "pair"]]:
    """Pairs that are each other's nearest neighbour, by direction and logarithm of distance from their camera."""
    offsets = gaussians.means.double() - cameras.double()[gaussians.views.long()]
    distances = offsets.norm(dim=1, keepdim=True).clamp_min(1e-9)
    labels = _labels(gaussians, len(cameras))
    features = torch.cat((offsets / distances, distances.log(), _LABEL_DISTANCE * labels[:, None]), dim=1).cpu().numpy()
    if len(features) < 2:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long)
    _, found = cKDTree(features, balanced_tree=False, compact_nodes=False).query(features, k=2, workers=-1)
    index = np.arange(len(features))
    nearest = np.where(found[:, 0] == index, found[:, 1], found[:, 0])
    is_pair = (nearest[nearest] == index) & (index < nearest)
    first, second = (torch.from_numpy(indices[is_pair]).to(labels) for indices in (index, nearest))
    same = labels[first] == labels[second]
    return first[same], second[same]


def _merge_cost(gaussians: Gaussians, contributions: Tensor, first: Tensor, second: Tensor) -> Float[Tensor, "pair"]:
    """Estimated mean absolute change of an image by each merger."""
    colors = SH_0 * gaussians.harmonics[:, 0]
    difference = (colors[first] - colors[second]).abs().mean(1)
    a, b = contributions[first], contributions[second]
    shared = 2 * a * b / (a + b).clamp_min(torch.finfo(a.dtype).tiny)
    return shared * difference + (a + b) * _BASE_COST


def _merge_pairs(first: Gaussians, second: Gaussians) -> Gaussians:
    """Gaussians with the mean, covariance and integral of opacity of each pair."""
    masses = [part.opacities.double() * _area(part.scales) for part in (first, second)]
    total = (masses[0] + masses[1]).clamp_min(1e-30)
    share = (masses[0] / total)[:, None]

    def average(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
        return weight * a.double() + (1 - weight) * b.double()

    means = average(first.means, second.means, share)
    spread = (first.means.double() - second.means.double()) * (share * (1 - share)).sqrt()
    covariances = average(
        first.to(dtype=torch.float64).covariances, second.to(dtype=torch.float64).covariances, share[:, :, None]
    )
    values, axes = torch.linalg.eigh(covariances + spread[:, :, None] * spread[:, None, :])
    axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
    scales = values.clamp_min(0).sqrt()
    return Gaussians(
        means=means.float(),
        scales=scales.float(),
        quats=quats_from_rotations(axes).float(),
        opacities=(total / _area(scales)).clamp_max(_MAX_OPACITY).float(),
        harmonics=average(first.harmonics, second.harmonics, share[:, :, None]).float(),
        levels=first.levels,
        views=first.views,
    )


def _area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Product of the two largest scales."""
    ordered = scales.double().sort(dim=1).values
    return (ordered[:, 1] * ordered[:, 2]).clamp_min(1e-30)
