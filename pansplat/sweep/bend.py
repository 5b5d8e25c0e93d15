"""One surface for each view: that of the single view, bent by matches.

The depth network sees whole surfaces in one photograph, with its edges, but places them by up to a third too near or
too far. The search places what two cameras see, and finds false matches where one does. The single view's surface is
therefore kept, and multiplied by a smooth field, which the search's reliable matches determine: the logarithm of the
field is a sum of fields from a nearly constant one to one of some pixels. A field does not cross discontinuities of the
single view's surface, or those that dense evidence shows. A finer field follows only enough evidence.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from pansplat.geometry.equirect import row_weights
from pansplat.sweep.panoramas import nearest_pixel, pad_sphere
from pansplat.sweep.smoothing import as_meridians, smooth_sphere
from pansplat.sweep.surface import PosedImages, Surface, world_points

_MIN_EVIDENCE = 1e-3  # fraction of the sphere with evidence, below which the field is the median of all pixels

# Evidence
_AGREEING_DEPTH = 0.03  # relative difference of depth up to which two surfaces agree; evidence ends at twice of it
_MAX_DIFFERENCE = 0.12  # mean difference of colour of 5x5 pixels above which a match is no evidence
_FULL_PARALLAX = 0.25  # angle between the two rays to a point from which a match has full weight, radians

# Fields, from the smoothest to the finest
_SMOOTHNESS = (1e5, 3e3, 300.0, 30.0, 3.0)  # coupling of neighbouring pixels, in full evidence (docs/what_was_tried.md)
_STIFFNESS = (0.0, 0.01, 0.02, 0.04, 0.05)  # evidence at which a field has half of its amplitude
_OUTLIER = (1.0, 0.6, 0.3, 0.15, 0.06)  # deviation in log-depth that halves the weight of a match; halls need the first
_ITERATIONS = 2  # weightings of the matches by their deviation, for each field
_DISCONTINUITY = 0.06  # difference of log-depth between neighbouring pixels that divides their coupling by e
_EVIDENCE_SLOPE = 0.02  # difference of the field by dense evidence up to which neighbouring pixels are no discontinuity


def bend_surfaces(
    posed: PosedImages,
    surfaces: Sequence[Surface],
    neighbours: Sequence[Sequence[int]],
    log_depths: Sequence[Float[np.ndarray, "h w"]],
) -> list[Surface]:
    """The surfaces of single views, bent towards those that a search found.

    Args:
        posed: photographs and poses, at the height of the surfaces.
        surfaces: found by matching.
        neighbours: the other views that each view was matched against.
        log_depths: logarithm of each single view's depth, up to a constant.
    """
    bent = []
    for view, (surface, log_depth) in enumerate(zip(surfaces, log_depths, strict=True)):
        evidence = measure_evidence(posed, surfaces, view, neighbours[view])
        field = fit_field(-np.log(surface.inverse_depth) - log_depth, evidence, log_depth)
        bent.append(Surface(np.exp(-log_depth - field).astype(np.float32)))
    return bent


def measure_evidence(
    posed: PosedImages, surfaces: Sequence[Surface], view: int, others: Sequence[int]
) -> Float[np.ndarray, "h w"]:
    """Weight in [0, 1] of each match of a view: surfaces and colours agree, and the rays have parallax.

    Args:
        posed: at the height of the surfaces.
        others: views; the best of them counts.
    """
    surface, pose = surfaces[view], posed.cam2world[view]
    points, image = world_points(surface, pose), posed.images[view]
    evidence = np.zeros(image.shape[:2], np.float32)
    for other in others:
        there = posed.cam2world[other]
        local = (points - there[:3, 3]) @ there[:3, :3]
        distance = np.linalg.norm(local, axis=-1)
        pixel = nearest_pixel(local, surface.height)
        deviation = np.abs(np.log(np.maximum(distance * surfaces[other].inverse_depth[pixel], 1e-6)))
        weight = np.clip(2 - deviation / _AGREEING_DEPTH, 0, 1) * posed.masks[other][pixel]
        difference = np.abs(posed.images[other][pixel] - image).mean(axis=2)
        mean = cv2.boxFilter(pad_sphere(difference, 2), -1, (5, 5))[2:-2, 2:-2]
        weight *= mean < _MAX_DIFFERENCE
        rays = points - pose[:3, 3]
        cosine = np.einsum("hwc,hwc->hw", rays, points - there[:3, 3])
        cosine /= np.maximum(np.linalg.norm(rays, axis=-1) * distance, 1e-9)
        parallax = np.arccos(np.clip(cosine, -1, 1))
        np.maximum(evidence, weight * np.minimum(parallax / _FULL_PARALLAX, 1), out=evidence)
    return evidence * posed.masks[view]


def fit_field(
    target: Float[np.ndarray, "h w"],
    evidence: Float[np.ndarray, "h w"],
    log_depth: Float[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w"]:
    """The logarithm of the field by which a view's depth is multiplied.

    Args:
        target: its value by the match of each pixel.
        evidence: weights of the matches.
        log_depth: logarithm of the single view's depth.
    """
    height = len(target)
    area = row_weights(height).numpy()[:, None] / row_weights(height).numpy().max()
    weight = evidence * area
    is_known = weight.sum() > _MIN_EVIDENCE * area.sum() * target.shape[1]
    field = np.full(target.shape, _weighted_median(target, weight if is_known else area + 0 * target))
    rows, meridians = _couple(target, evidence, log_depth)
    for smoothness, stiffness, outlier in zip(_SMOOTHNESS, _STIFFNESS, _OUTLIER, strict=True):
        for _ in range(_ITERATIONS):
            rest = target - field
            weighted = weight / (1 + (rest / outlier) ** 2)
            sums = smooth_sphere(np.stack((weighted * rest, weighted)), rows, meridians, smoothness)
            field = field + sums[0] / (sums[1] + stiffness * area + 1e-9)
    return field


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = values.ravel().argsort(kind="stable")
    total = weights.ravel()[order].cumsum()
    return float(values.ravel()[order[np.searchsorted(total, 0.5 * total[-1])]])


def _couple(target: np.ndarray, evidence: np.ndarray, log_depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Couplings of each pixel with the next one of its row, and of its meridian as `as_meridians` has them."""
    dense = cv2.boxFilter(pad_sphere(evidence.astype(np.float32), 2), -1, (5, 5))[2:-2, 2:-2]
    found = cv2.medianBlur(pad_sphere(target.astype(np.float32), 2), 5)[2:-2, 2:-2]  # without single false matches
    maps = np.stack((log_depth, found, dense)).astype(np.float64)
    couplings = []
    for lines in (maps, as_meridians(maps)):
        following = np.roll(lines, -1, axis=-1)
        jumps, field_jumps, _ = np.abs(following - lines)
        field_jumps = np.maximum(field_jumps - _EVIDENCE_SLOPE, 0) * np.minimum(lines[2], following[2])
        couplings.append(np.exp(-(jumps + field_jumps) / _DISCONTINUITY))
    rows, meridians = couplings
    return rows, meridians
