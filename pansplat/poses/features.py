"""Local features of panoramas as bearings with descriptors, and matches between two panoramas.

SIFT assumes an image without distortion. It therefore runs on the faces of a cube, which overlap so that no feature
is lost at their borders; each face contributes the features that are nearest to its own axis. Faces in other
directions give features with other errors, and describe what the first ones see obliquely. Descriptors are
root-normalised.

Source: D. Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004; R. Arandjelovic, A. Zisserman,
Three things everyone should know to improve object retrieval, CVPR 2012.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray as Array

from pansplat.geometry.pose import rotations_from_quats
from pansplat.poses.depth import sample_nearest
from pansplat.poses.solvers import compiled

_FIELD_OF_VIEW = 100.0  # angle of a face, degrees; 10 more than a cube's
_CONTRAST, _EDGE = 0.015, 12.0  # thresholds of SIFT; low, because matching removes weak features
_FEATURES = 8000  # largest number for a panorama
_DIM_BRIGHTNESS = 16.0  # mean grey value below which an image is brightened
_REPEATED_MATCH = 0.008  # nearer matches count once, radians in both panoramas together
_NOISE_PIXELS, _MIN_NOISE = 0.45, 8e-4  # noise of a right match's epipolar angle: pixels at the horizon; radians
# Prior probability that a match is right, by its ratio; measured on pairs of real panoramas 2 to 3 m apart.
_RATIOS, _PRIORS = (0.5, 0.65, 0.75, 0.8, 0.85, 0.9, 1.0), (0.8, 0.6, 0.3, 0.15, 0.06, 0.02, 0.005)
_CHUNK = 256  # descriptors that are compared together

_HALF = math.sqrt(0.5)
_FACE_QUATS = (
    (1, 0, 0, 0), (_HALF, 0, _HALF, 0), (0, 0, 1, 0), (_HALF, 0, -_HALF, 0),
    (_HALF, _HALF, 0, 0), (_HALF, -_HALF, 0, 0),
)  # fmt: skip
FACE_ROTATIONS: Float[Array, "6 3 3"] = rotations_from_quats(torch.tensor(_FACE_QUATS, dtype=torch.float64)).numpy()
"""Axes of the cube's faces in the camera's frame, as columns; the four horizontal ones first."""
DIAGONAL: Float[Array, "3 3"] = np.array(((_HALF, 0.0, _HALF), (0.0, 1.0, 0.0), (-_HALF, 0.0, _HALF)))
"""A turn by 45 degrees about the y axis."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one panorama, strongest first.

    Attributes:
        bearings: unit directions in the camera's frame.
        descriptors: unit vectors.
        sizes: diameters of the described places, pixels; the bearing of a large one is less exact.
        noise: standard deviation of the epipolar angle of a right match, radians.
    """

    bearings: Float[Array, "feature 3"]
    descriptors: Float[Array, "feature 128"]
    sizes: Float[Array, "feature"]
    noise: Float[Array, "feature"]

    def __len__(self) -> int:
        return len(self.bearings)

    def strongest(self, count: int) -> Features:
        """The first `count` features."""
        return Features(self.bearings[:count], self.descriptors[:count], self.sizes[:count], self.noise[:count])

    def joined(self, other: Features) -> Features:
        """These features, then those of `other`."""
        names = ("bearings", "descriptors", "sizes", "noise")
        return Features(*(np.concatenate((getattr(self, name), getattr(other, name))) for name in names))

    def mirrored(self) -> Features:
        """The features of the panorama that is mirrored left to right.

        A descriptor has 4 x 4 cells of 8 directions, along and across the feature's main direction. A mirror image
        reverses the order across it, and the sense of the directions.
        """
        cells = self.descriptors.reshape(-1, 4, 4, 8)[:, ::-1, :, (0, 7, 6, 5, 4, 3, 2, 1)]
        descriptors = np.ascontiguousarray(cells).reshape(-1, 128)
        return Features(self.bearings * (-1.0, 1.0, 1.0), descriptors, self.sizes, self.noise)


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of features, the most probable first.

    Attributes:
        indices: numbers of the features in the first and in the second panorama.
        prior: probability of each match to be right, before any pose is known.
    """

    indices: Int[Array, "match 2"]
    prior: Float[Array, "match"]

    def __len__(self) -> int:
        return len(self.indices)

    def joined(self, other: Matches) -> Matches:
        """These matches and those of `other`, sorted."""
        prior = np.concatenate((self.prior, other.prior))
        order = np.argsort(-prior, kind="stable")
        return Matches(np.concatenate((self.indices, other.indices))[order], prior[order])

    def shifted(self, first: int, second: int) -> Matches:
        """The matches of features that follow `first` and `second` other ones."""
        return Matches(self.indices + np.array((first, second)), self.prior)


NO_MATCHES = Matches(np.empty((0, 2), np.int64), np.empty(0))


def detect_features(
    image: UInt8[Array, "height width"],
    mask: Bool[Array, "height width"] | None = None,
    *,
    rotations: Float[Array, "6 3 3"] = FACE_ROTATIONS,
    faces: int = 6,
) -> Features:
    """The strongest features of a grey panorama, outside the masked pixels.

    Args:
        mask: True where the panorama shows the scene.
        rotations: axes of the faces of a cube in the camera's frame, as columns.
        faces: number of the faces that are used, the first ones.
    """
    if image.mean() < _DIM_BRIGHTNESS:
        image = cv2.equalizeHist(image)
    focal = image.shape[1] / (2 * math.pi)  # a face has the panorama's resolution at its centre
    sift = cv2.SIFT_create(contrastThreshold=_CONTRAST, edgeThreshold=_EDGE)
    bearings, descriptors, keypoints = [np.empty((0, 3))], [np.empty((0, 128), np.float32)], [np.empty((0, 2))]
    for face, rotation in enumerate(rotations[:faces]):
        pixels = render_face(image, rotation, focal)
        margin = int(len(pixels) / 2 - focal) - 1  # what lies outside the face of a cube needs no descriptors
        inside = np.zeros_like(pixels)
        inside[margin : len(pixels) - margin, margin : len(pixels) - margin] = 255
        points, found = sift.detectAndCompute(pixels, inside)
        if found is None or not len(points):
            continue
        xy = (np.array([point.pt for point in points]) + 0.5 - len(pixels) / 2) / focal
        rays = np.concatenate((xy, np.ones((len(xy), 1))), axis=1)
        rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ rotation.T
        own = (rays @ rotations[:, :, 2].T).argmax(axis=1) == face
        if mask is not None:
            own &= sample_nearest(mask, rays) > 0
        bearings.append(rays[own])
        descriptors.append(found[own])
        keypoints.append(np.array([(point.response, point.size) for point in points])[own])
    strength, sizes = np.concatenate(keypoints).T
    order = np.argsort(-strength, kind="stable")[:_FEATURES]
    descriptor = np.concatenate(descriptors)[order]
    descriptor = np.sqrt(descriptor / np.maximum(descriptor.sum(axis=1, keepdims=True), 1e-9))
    noise = np.full(len(order), max(_NOISE_PIXELS * 2 * math.pi / image.shape[1], _MIN_NOISE))
    return Features(np.concatenate(bearings)[order], descriptor.astype(np.float32), sizes[order], noise)


def render_face(
    image: UInt8[Array, "height width *channel"], rotation: Array, focal: float
) -> UInt8[Array, "side side *channel"]:
    """The perspective image of a face."""
    height, width = image.shape[:2]
    side = int(2 * math.tan(math.radians(_FIELD_OF_VIEW / 2)) * focal)
    steps = ((np.arange(side) + 0.5 - side / 2) / focal).astype(np.float32)
    axes = rotation.astype(np.float32)
    rows = steps[:, None, None] * axes[:, 1] + axes[:, 2]
    x, y, z = np.moveaxis(rows + steps[:, None] * axes[:, 0], -1, 0)
    margin = 4
    u = np.arctan2(x, z) * np.float32(width / (2 * math.pi)) + np.float32(width / 2 - 0.5 + margin)
    v = np.arctan2(y, np.sqrt(x * x + z * z)) * np.float32(height / math.pi) + np.float32(height / 2 - 0.5)
    padded = cv2.copyMakeBorder(image, 0, 0, margin, margin, cv2.BORDER_WRAP)
    return cv2.remap(padded, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def match_features(first: Features, second: Features) -> Matches:
    """Mutually nearest descriptors; one match for each pair of places.

    The prior follows from the ratio: distance of the descriptors over that to the second nearest one, mean of both
    panoramas.
    """
    if min(len(first), len(second)) < 2:
        return NO_MATCHES
    a, b = torch.from_numpy(first.descriptors), torch.from_numpy(second.descriptors)
    rows, columns = (np.full((len(each), 2), -1.0, np.float32) for each in (a, b))  # the two largest similarities
    column_of, row_of = np.zeros(len(a), np.int64), np.zeros(len(b), np.int64)
    for start in range(0, len(a), _CHUNK):
        part = slice(start, start + _CHUNK)
        _keep_nearest((a[part] @ b.T).numpy(), start, rows[part], column_of[part], columns, row_of)
    mutual = np.flatnonzero(row_of[column_of] == np.arange(len(a)))
    indices = np.stack((mutual, column_of[mutual]), axis=1)
    by_row, by_column = (
        np.sqrt(np.maximum(1 - two.astype(np.float64), 0)) for two in (rows[mutual], columns[indices[:, 1]])
    )
    ratio = 0.5 * by_row[:, 0] * (1 / np.maximum(by_row[:, 1], 1e-3) + 1 / np.maximum(by_column[:, 1], 1e-3))
    order = np.argsort(ratio, kind="stable")
    prior = np.interp(ratio[order], _RATIOS, _PRIORS)
    return drop_repeated(first, second, Matches(indices[order], prior))


@compiled
def _keep_nearest(similarity, start, rows, column_of, columns, row_of):
    """Update the two largest similarities of rows and columns, and where the largest are, by rows from `start` on."""
    for i in range(len(similarity)):
        most, second, place = rows[i, 0], rows[i, 1], column_of[i]
        for j in range(similarity.shape[1]):
            value = similarity[i, j]
            if value > second:
                if value > most:
                    most, second, place = value, most, j
                else:
                    second = value
            if value > columns[j, 1]:
                if value > columns[j, 0]:
                    columns[j, 0], columns[j, 1], row_of[j] = value, columns[j, 0], start + i
                else:
                    columns[j, 1] = value
        rows[i, 0], rows[i, 1], column_of[i] = most, second, place


def drop_repeated(first: Features, second: Features, matches: Matches) -> Matches:
    """Matches without those that connect the same two places as a better one.

    SIFT describes a place again for each dominant orientation and size; such matches are not independent evidence.
    """
    places = first.bearings[matches.indices[:, 0]], second.bearings[matches.indices[:, 1]]
    kept = are_distinct(np.concatenate(places, axis=1))
    return Matches(matches.indices[kept], matches.prior[kept])


def are_distinct(places: Float[Array, "match n"]) -> Bool[Array, "match"]:
    """Whether no better match that is kept has the same place; bearings of one or both panoramas, best match first."""
    kept = np.ones(len(places), bool)
    if not len(places):
        return kept
    near = scipy.spatial.cKDTree(places).query_pairs(_REPEATED_MATCH, output_type="ndarray")  # the better match first
    for better, worse in near[np.argsort(near[:, 1], kind="stable")].tolist():
        if kept[better]:
            kept[worse] = False
    return kept
