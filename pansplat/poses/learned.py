"""Learned features of panoramas, and matches between two panoramas with the probability of each.

ALIKED finds keypoints on the four horizontal faces of a cube, which should be turned along the walls: the same wall
then has the same direction in both panoramas. Distinctive descriptors are counted for each pair of faces, and
LightGlue matches the pairs with most of them. Where SIFT needs the same texture, it also uses the arrangement of the
keypoints. How often a match is right depends on its score, and more on how many others its faces have in common.

Source: docs/adr/0015-a-learned-matcher-is-shipped.md.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray as Array
from torch import Tensor, nn

from pansplat.networks.aliked import Aliked
from pansplat.networks.lightglue import LightGlue
from pansplat.networks.weights import load_weights, require_shapes
from pansplat.poses.features import FACE_ROTATIONS, NO_MATCHES, Matches, are_distinct, render_face

_FACES = 4  # horizontal ones; floor and ceiling have few keypoints, and no upright direction
_KEYPOINTS = 640  # largest number for a face
_STRIDE = 32  # pixels; the sides of an image are multiples of it
_FACE_PAIRS = 6  # LightGlue matches so many pairs of faces: those with most distinctive descriptors in common
_DISTINCT_RATIO = 0.85  # largest ratio of distances to the nearest and the second nearest descriptor
_MIN_SCORE, _MAX_SCORE = 0.1, 0.9995  # least score of a match that is used; largest one in the calibration
_CONFIDENT = 0.3  # matches of a higher score count for their pair of faces
# Log-odds that a match is right: constant, per log-odds of its score, per logarithm of 1 + the sum of the confident
# scores of its pair of faces. Logistic regression over the 78 pairs of a real home (docs/poses.md).
_CALIBRATION = -4.84, 0.264, 1.586


class Matcher(nn.Module):
    """Both networks of the learned matcher."""

    def __init__(self) -> None:
        super().__init__()
        self.aliked = Aliked()
        self.lightglue = LightGlue()


def default_weights() -> Path:
    """The weights of the learned matcher that the package ships."""
    return Path(str(files("pansplat.matcher").joinpath("matcher.safetensors")))


@functools.cache
def load_matcher(device: torch.device) -> Matcher:
    """The learned matcher in eval mode."""
    path = default_weights()
    weights = load_weights(path)
    matcher = Matcher().requires_grad_(False)
    require_shapes(weights.tensors, matcher.state_dict(), path)
    matcher.load_state_dict(weights.tensors)
    return matcher.eval().to(device)


@dataclass(frozen=True, eq=False)
class LearnedFeatures:
    """Learned features of one panorama, sorted by face, the strongest of each face first.

    Faces overlap: a place near the border of two faces can have a feature in each.

    Attributes:
        bearings: unit directions in the camera's frame.
        descriptors: unit vectors.
        points: positions x, y on the face, -1 to 1.
        starts: index of each face's first feature, and the number of features.
    """

    bearings: Float[Array, "feature 3"]
    descriptors: Float[Tensor, "feature 128"]
    points: Float[Tensor, "feature 2"]
    starts: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.bearings)

    def face(self, number: int) -> tuple[Float[Tensor, "keypoint 2"], Float[Tensor, "keypoint 128"]]:
        """Positions and descriptors of a face."""
        own = slice(*self.starts[number : number + 2])
        return self.points[own], self.descriptors[own]


LEAST_COMMON = 18
"""Distinctive descriptors in common of two panoramas of one room: those of other rooms have 10 to 90, all pairs with a
pose of four real homes 21 or more (docs/poses.md)."""
NO_LEARNED = LearnedFeatures(np.empty((0, 3)), torch.empty(0, 128), torch.empty(0, 2), (0,) * (_FACES + 1))


def detect_learned(
    matcher: Matcher,
    image: UInt8[Array, "height width 3"],
    mask: Bool[Array, "height width"],
    frame: Float[Array, "3 3"],
) -> LearnedFeatures:
    """Learned features of an RGB panorama, outside the masked pixels.

    Args:
        mask: True where the panorama shows the scene.
        frame: axes of the walls in the camera's frame, as columns x, y (down), z.
    """
    focal, device = image.shape[1] / (2 * math.pi), next(matcher.parameters()).device
    bearings, descriptors, places, starts = [], [], [], [0]
    for rotation in frame @ FACE_ROTATIONS[:_FACES]:
        pixels = render_face(image, rotation, focal)
        margin = len(pixels) % _STRIDE
        side = len(pixels) - margin
        pixels = pixels[margin // 2 :][:side, margin // 2 :][:, :side]
        centre = len(pixels) / 2 + margin / 2 - margin // 2  # pixels from the corner of the face
        inside = render_face(mask.astype(np.uint8), rotation, focal)[margin // 2 :][:side, margin // 2 :][:, :side]
        allowed = torch.from_numpy(inside > 0)
        with torch.inference_mode():
            rgb = torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
            found = matcher.aliked(rgb.to(device), allowed.to(device), _KEYPOINTS)
        points, described = (each.cpu() for each in found)
        xy = (points.double().numpy() + 0.5 - centre) / focal
        rays = np.concatenate((xy, np.ones((len(xy), 1))), axis=1)
        bearings.append(rays / np.linalg.norm(rays, axis=1, keepdims=True) @ rotation.T)
        descriptors.append(described)
        places.append((points - side / 2) / (side / 2))
        starts.append(starts[-1] + len(points))
    return LearnedFeatures(np.concatenate(bearings), torch.cat(descriptors), torch.cat(places), tuple(starts))


def match_learned(
    matcher: Matcher, first: LearnedFeatures, second: LearnedFeatures, *, least_common: int = 0
) -> Matches:
    """Matches of two panoramas, whose prior is the probability that each is right.

    A match that contradicts or repeats a more probable one is left out.

    Args:
        least_common: panoramas with fewer distinctive descriptors in common have no matches.
    """
    common, device = count_common(first, second), next(matcher.parameters()).device
    order = np.argsort(-common, axis=None, kind="stable")[:_FACE_PAIRS]
    if common.flat[order].sum() < least_common:
        return NO_MATCHES
    indices, priors = [np.empty((0, 2), np.int64)], [np.empty(0)]
    constant, by_score, by_support = _CALIBRATION
    for i, j in np.stack(np.unravel_index(order, common.shape), axis=1).tolist():
        with torch.inference_mode():
            faces = (tuple(each.to(device) for each in face) for face in (first.face(i), second.face(j)))
            index, score = (each.cpu().double().numpy() for each in matcher.lightglue(*faces))
        kept, clipped = score > _MIN_SCORE, score.clip(_MIN_SCORE, _MAX_SCORE)
        support = math.log1p(float(score[score > _CONFIDENT].sum()))
        odds = constant + by_score * np.log(clipped / (1 - clipped)) + by_support * support
        indices.append((index[kept] + (first.starts[i], second.starts[j])).astype(np.int64))
        priors.append(1 / (1 + np.exp(-odds[kept])))
    index, prior = np.concatenate(indices), np.concatenate(priors)
    order = np.argsort(-prior, kind="stable")
    a, b = first.bearings[index[order, 0]], second.bearings[index[order, 1]]
    order = order[are_distinct(a) & are_distinct(b)]
    return Matches(index[order], prior[order])


def count_common(first: LearnedFeatures, second: LearnedFeatures) -> Int[Array, "face face"]:
    """Number of distinctive, mutually nearest descriptors of each pair of faces."""
    count = np.zeros((_FACES, _FACES), np.int64)
    for i, j in itertools.product(range(_FACES), repeat=2):
        similarity = first.face(i)[1] @ second.face(j)[1].T
        if min(similarity.shape) < 2:
            continue
        nearest, index = similarity.topk(2, dim=1)
        mutual = similarity.argmax(dim=0)[index[:, 0]] == torch.arange(len(similarity))
        squared = (1 - nearest).clamp_min(0)  # half of the squared distances
        distinct = squared[:, 0] < _DISTINCT_RATIO**2 * squared[:, 1]
        count[i, j] = int((mutual & distinct).sum())
    return count
