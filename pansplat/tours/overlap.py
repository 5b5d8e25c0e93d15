"""Overlap of panoramas, measured in small images by a sweep over depth; it gives a tour its edges."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.equirect import pad_equirect, row_weights
from pansplat.geometry.warp import relative_pose, warp_panorama
from pansplat.images.image_files import read_panorama
from pansplat.inputs.content import hash_image
from pansplat.system.progress import report_progress, stage
from pansplat.system.source_hash import hash_sources
from pansplat.system.store import Store, hash_parts
from pansplat.tours.graph import Edge, TourGraph

_HEIGHT = 48  # rows of the images that are compared
_CANDIDATES = 24  # number of depths that a pixel is compared at
_MIN_OVERLAP = 0.12  # least overlap of an edge that is not given
_MIN_GIVEN_OVERLAP = 0.03  # least overlap of one that is; flights of furnished homes with a free way have 0.1 or more
_MAX_BASELINE = 0.4  # largest length of an edge that is not given, as a fraction of far
_MAX_NEIGHBOURS = 6  # number of the nearest panoramas that each is compared with


@stage()
def connect(tour: TourGraph) -> TourGraph:
    """The tour with measured overlaps, and with edges between further panoramas that overlap.

    Each panorama is compared with its nearest neighbours within 0.4 far, of those with poses in the same world. Given
    edges are walls if their panoramas show nothing in common.
    """
    world = np.array([panorama.world for panorama in tour.panoramas])
    distances = np.linalg.norm(tour.positions[:, None] - tour.positions[None], axis=2).round(6)  # equal in a grid
    distances[world[:, None] != world] = np.inf
    compared = {(a, b) for a, b in tour.overlaps if a != b}
    for node in range(len(tour)):
        for other in distances[node].argsort(kind="stable")[1 : _MAX_NEIGHBOURS + 1].tolist():
            if other != node and distances[node, other] <= _MAX_BASELINE * tour.far:
                compared.add((min(node, other), max(node, other)))
    edges, images = sorted(compared), {node: tour.panoramas[node].image for edge in compared for node in edge}
    key = hash_parts(
        hash_sources(__name__),
        json.dumps([edges, tour.near, tour.far, [(node, hash_image(images[node])) for node in sorted(images)]]),
        tour.cam2world[sorted(images)].numpy(),
    )
    measured = Store(tour.folder).get("overlaps", key, lambda: _measure_overlaps(tour, edges))
    overlaps, walls = {}, []
    for edge, overlap in zip(edges, measured, strict=True):
        if overlap >= (_MIN_GIVEN_OVERLAP if edge in tour.overlaps else _MIN_OVERLAP):
            overlaps[edge] = overlap
        elif edge in tour.overlaps:
            walls.append(edge)
    return dataclasses.replace(tour, overlaps=overlaps).with_walls(walls)


def _measure_overlaps(tour: TourGraph, edges: Sequence[Edge]) -> list[float]:
    """The overlap of each pair of panoramas."""
    features, overlaps = {}, []
    for node in sorted({node for edge in edges for node in edge}):
        report_progress("comparing panoramas", 0.5 * node / len(tour))
        features[node] = _compute_features(read_panorama(tour.panoramas[node].image, _HEIGHT)[0])
    for index, (a, b) in enumerate(edges):
        report_progress("comparing panoramas", 0.5 + 0.5 * index / len(edges))
        overlaps.append(_measure_overlap(features[a], features[b], tour.cam2world[[a, b]], tour.near, tour.far))
    return overlaps


def _compute_features(image: Float[Tensor, "3 height width"]) -> Float[Tensor, "feature height width"]:
    """Colour, and brightness and gradients relative to the local contrast."""
    gray = image.mean(dim=0)
    window = pad_equirect(gray, 3)[None, None]
    mean = torch.nn.functional.avg_pool2d(window, 7, stride=1)[0, 0]
    square = torch.nn.functional.avg_pool2d(window * window, 7, stride=1)[0, 0]
    contrast = 2 * (square - mean * mean).clamp_min(0).sqrt() + 0.06
    padded = pad_equirect(gray, 1)
    right = padded[1:-1, 2:] - padded[1:-1, :-2]
    down = padded[2:, 1:-1] - padded[:-2, 1:-1]
    return torch.cat((1.5 * image, torch.stack((gray - mean, right, down)) / contrast))


def _measure_overlap(
    first: Float[Tensor, "feature height width"],
    second: Float[Tensor, "feature height width"],
    poses: Float[Tensor, "2 4 4"],
    near: float,
    far: float,
) -> float:
    """One minus the error of the best depth at each pixel, relative to the error with a wrong rotation.

    With the other panorama turned by a quarter, the best depth of a pixel is chance.
    """
    errors, chances = 0.0, 0.0
    for reference, other, pair in ((first, second, poses), (second, first, poses.flip(0))):
        motion = relative_pose(pair[0], pair[1])
        errors += _sweep_error(reference, other, motion, near, far)
        for sign in (1, -1):
            turn = torch.eye(4, dtype=torch.float64)
            turn[0, 0] = turn[2, 2] = 0
            turn[0, 2], turn[2, 0] = sign, -sign
            chances += 0.5 * _sweep_error(reference, other, turn @ motion, near, far)
    return 1 - errors / max(chances, 1e-9)


def _sweep_error(
    reference: Float[Tensor, "feature height width"],
    other: Float[Tensor, "feature height width"],
    motion: Float[Tensor, "4 4"],
    near: float,
    far: float,
) -> float:
    """Mean over the sphere of the smallest difference over all depth candidates."""
    height, width = reference.shape[-2:]
    inverse = torch.linspace(1 / far, 1 / near, _CANDIDATES)[None, :, None, None].expand(1, -1, height, width)
    warped = warp_panorama(other[None], inverse, motion.float()[None])[0]
    difference = (warped - reference[:, None]).abs().clamp_max(1.0).mean(dim=0)
    lowest = torch.nn.functional.avg_pool2d(pad_equirect(difference, 2)[:, None], 5, stride=1)[:, 0].amin(dim=0)
    weights = row_weights(height, dtype=lowest.dtype)[:, None].expand(height, width)
    return float((lowest * weights).sum() / weights.sum())
