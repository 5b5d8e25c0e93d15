"""Whole surfaces: smooth errors of depth are not seen, sharp ones are.

Matches and a depth network place some pixels of a thing wrongly. Where they do, it is torn when the camera moves; the
same error bends it slightly when it is spread. Inverse depth is therefore averaged over an angle that grows with the
parallax of half a flight. It is linear in the ray on a plane (u = n . ray), so that no plane is bent.

Along a straight line in space, inverse depth is a cos t + b sin t, where t is the angle along its great circle. This is
fitted to each straight segment of the photograph, and a smooth factor brings the surface there.

Source: Liu, Gleicher, Jin and Agarwala, "Content-preserving warps for 3D video stabilization", SIGGRAPH 2009.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float

from pansplat.sweep.joined_crops import crop_axes, crop_panorama, pixel_rays
from pansplat.sweep.panoramas import nearest_pixel
from pansplat.sweep.smoothing import as_meridians, smooth_sphere

# Angles are in radians.
_BASELINE_ANGLE = math.radians(1.5)  # deviation of the average where depth is the baseline (docs/what_was_tried.md)
_MAX_ANGLE = math.radians(4)
_CROP_SHARE = 0.5  # height of the crops in which segments are found, relative to the panorama's
_CONTRAST = 20, 60  # grey values up to 255; thresholds of Canny's edge detector
_MAX_LINE_ERROR = 1.414  # pixels between an edge and its segment
_MIN_LENGTH = math.radians(5)
_FULL_WEIGHT = math.radians(10)  # length of a segment of weight 1
_OUTLIER = 0.1  # deviation of log-depth from a segment's fit that halves a weight
_FIELD_ANGLE = math.radians(1.5)  # standard deviation of the smooth factor beside a segment
_STIFFNESS = 0.05  # weight of a factor of 1, that is, of no change
_ITERATIONS = 3  # rounds of fits of the segments, each followed by their factors
_FIT_ITERATIONS = 3  # reweightings within a fit


def make_whole(
    inverse_depth: Float[np.ndarray, "h w"], image: Float[np.ndarray, "h w 3"], baseline: float
) -> Float[np.ndarray, "h w"]:
    """A view's inverse depth, smooth where parallax is large, and straight along straight segments of its photograph.

    Args:
        baseline: distance of the cameras between which one flies, in the unit of depth.
    """
    angle = np.minimum(_BASELINE_ANGLE * baseline * inverse_depth.astype(np.float64), _MAX_ANGLE)
    whole = _average(np.stack((inverse_depth, np.ones_like(inverse_depth))), angle)[0]
    segments = find_segments(image)
    pixels, number, angles, weight = _sample_segments(segments, len(image))
    field_angle = np.full_like(angle, _FIELD_ANGLE)
    for _ in range(_ITERATIONS if len(segments) else 0):
        change, certainty = _fit_segments(whole[pixels], number, angles)
        sums = np.zeros((2, *angle.shape))
        np.add.at(sums[0], pixels, certainty * weight * change)
        np.add.at(sums[1], pixels, certainty * weight)
        sums = _average(sums, field_angle)
        whole *= np.exp(sums[0] / (sums[1] + _STIFFNESS))
    return whole.astype(np.float32)


def find_segments(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "segment 2 3"]:
    """Unit directions of both ends of the straight segments of a photograph; crops that overlap repeat some."""
    size = max(round(_CROP_SHARE * len(image)), 8)
    gray = torch.from_numpy(np.ascontiguousarray(image)).mean(dim=2)[None].clamp(0, 1)
    crops = (crop_panorama(gray, (size, size))[:, 0] * 255).round().byte().numpy()
    shortest = max(round(_MIN_LENGTH * len(image) / math.pi), 6)
    detector = cv2.ximgproc.createFastLineDetector(shortest, _MAX_LINE_ERROR, *_CONTRAST, 3, True)
    found = [np.zeros((0, 2, 3))]
    for crop, axes in zip(crops, crop_axes().numpy(), strict=True):
        ends = detector.detect(crop)
        if ends is not None:
            rays = pixel_rays(torch.from_numpy(ends).double().reshape(-1, 2, 2), (size, size)).numpy() @ axes.T
            found.append(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    segments = np.concatenate(found)
    return segments[_measure_lengths(segments) > _MIN_LENGTH]


def _measure_lengths(segments: np.ndarray) -> np.ndarray:
    return np.arccos(np.clip((segments[:, 0] * segments[:, 1]).sum(axis=-1), -1, 1))


def _sample_segments(
    segments: Float[np.ndarray, "segment 2 3"], height: int
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Samples of segments and of the pixels at both sides: pixels (rows, columns), segments, angles, and weights."""
    length = _measure_lengths(segments)
    counts = np.maximum(np.ceil(length * height / math.pi).astype(int), 4)
    number = np.repeat(np.arange(len(segments)), counts)
    share = (np.arange(len(number)) + 0.5 - np.repeat(counts.cumsum() - counts, counts)) / counts[number]
    angles = share * length[number]
    start, end = segments[:, 0], segments[:, 1]
    across = np.cross(start, end)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    along = start[number] * np.cos(angles)[:, None] + np.cross(across, start)[number] * np.sin(angles)[:, None]
    tracks = [nearest_pixel(along + side * math.pi / height * across[number], height) for side in (-1, 0, 1)]
    rows, columns = (np.concatenate(indices) for indices in zip(*tracks, strict=True))
    number = np.concatenate([number + side * len(segments) for side in range(3)])
    return (rows, columns), number, np.tile(angles, 3), np.tile(length, 3)[number] / _FULL_WEIGHT


def _fit_segments(values: np.ndarray, number: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The change of log inverse depth of each sample to its segment's fit, and its weight.

    Samples on several surfaces fit no straight line: the weight falls with the fourth power of the mean weight.
    """
    cosine, sine, weight = np.cos(angles), np.sin(angles), np.ones_like(values)
    change = np.zeros_like(values)
    for _ in range(_FIT_ITERATIONS):
        products = cosine * cosine, cosine * sine, sine * sine, cosine * values, sine * values
        # Errors are relative, so that the near end of a segment does not dominate.
        cc, cs, ss, c, s = (np.bincount(number, weight * product / values**2) for product in products)
        determinant = cc * ss - cs * cs + 1e-12 * (cc + ss) ** 2
        first, second = (c * ss - s * cs) / determinant, (s * cc - c * cs) / determinant
        fit = first[number] * cosine + second[number] * sine
        change = np.log(np.maximum(fit / values, 0.2))
        weight = 1 / (1 + (change / _OUTLIER) ** 2)
    certainty = np.bincount(number, weight) / np.bincount(number).clip(1)
    return change, weight * certainty[number] ** 4


def _average(maps: Float[np.ndarray, "2 h w"], angle: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "2 h w"]:
    """Panoramas averaged over angles, standard deviations of about a Gaussian."""
    lines = (angle * len(angle) / math.pi) ** 2
    rows, meridians = (0.5 * (each + np.roll(each, -1, axis=-1)) for each in (lines, as_meridians(lines)))
    return smooth_sphere(maps.astype(np.float64), rows, meridians, 1.0)
