"""Check of poses against images, and of common mistakes in the convention of the poses.

Each view is warped into the next one with the poses as given and under each common mistake. A small sphere sweep finds
the depth, so that no model is needed. With the right poses nearly every pixel matches at some depth; with wrong poses
few pixels do.
"""

from __future__ import annotations

import itertools
import math
import statistics
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pansplat.errors import InputError
from pansplat.geometry.equirect import pad_equirect, pixel_directions, row_weights, uv_from_directions
from pansplat.geometry.pose import invert_pose
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.inputs.views import Views

AS_GIVEN = "as given"

_HEIGHT = 64  # rows of the images that are compared
_CANDIDATES = 32  # inverse depths that are compared
_WINDOW_RADIUS = 2  # pixels; half size of the window over which differences are averaged
_DIFFERENCE_CAP = 0.6  # largest difference of a feature; it limits the effect of occlusions
# Another interpretation is reported if its error is below this ratio of the error as given, below this error, and
# smaller by this difference (a ratio of nearly perfect fits is not significant).
_MAX_RATIO, _MAX_ERROR, _MIN_DIFFERENCE = 0.92, 0.46, 0.02
# Views of different rooms fit all interpretations about equally, one of them best by chance: a fit is distinct if its
# error is below this ratio of the median. With it 4 instead of 14 of 106 right poses (zind and villa_8, on which it was
# chosen) seem a mistake, and 5 instead of 8 of 91 of four other homes.
_DISTINCT_RATIO = 0.9
_NO_OVERLAP = 0.5  # an interpretation with a larger error fits only if it is distinct
_SIMILAR_RATIO = 1.03  # ratio to the error as given, up to which an interpretation fits about as well
_SAME_POSE = 0.02  # largest difference of equal relative poses (translation relative to its length)

_ADVICE = {
    # The inverse of a matrix also exchanges the sides of its axes, so this advice names both parts of the convention.
    "inverse": 'the matrices look like the inverse of the stated ones, with OpenCV axes: exchange "cam2world" '
    'and "world2cam", and state "opencv"',
    "opengl axes": "the camera axes look like OpenGL's (y up, z backward) where OpenCV's were stated, or the "
    'reverse: exchange "opencv" and "opengl"',
    "inverse, opengl axes": "the matrices look like the inverse of the stated ones, with OpenGL axes: exchange "
    '"cam2world" and "world2cam", and state "opengl"',
    "transposed rotation": "the rotations look inverted while the translations are right: transpose the 3x3 "
    "parts, or conjugate the quaternions",
    "swapped views": "the poses of the two views look exchanged: check which pose belongs to which image",
    "mirrored left-right": "the scene looks mirrored left to right: a flipped image or a left-handed world",
    "mirrored up-down": "the up axis looks flipped alone (a left-handed system): flip a second axis with it",
    "mirrored front-back": "the forward axis looks flipped alone (a left-handed system): flip a second axis with it",
    "z-up camera": "the camera axes look like x right, y forward, z up: rotate them to x right, y down, z forward",
    "x-forward camera": "the camera axes look like x forward, y left, z up (robotics, ROS): rotate them to "
    "x right, y down, z forward",
    "turned by 90 degrees": "the panoramas' centre looks along the camera's x axis: rotate the poses by 90 "
    "degrees about the vertical axis or shift the images by a quarter",
    "turned by 180 degrees": "the panoramas' centre looks backward: rotate the poses by 180 degrees about the "
    "vertical axis or shift the images by half",
    "turned by -90 degrees": "the panoramas' centre looks along the camera's -x axis: rotate the poses by -90 "
    "degrees about the vertical axis or shift the images by a quarter",
}


@dataclass(frozen=True)
class PoseCheck:
    """The result of a pose check.

    Attributes:
        name: the pair's.
        baseline: largest distance between context cameras, metres.
        error: photometric error of the warp with the poses as given: 0 for a perfect fit, about 1 for unrelated images.
        errors: the error for each interpretation of the poses, best first; `AS_GIVEN` is one.
        indistinguishable: interpretations with the same relative pose as given.
        likely_mistake: advice if another interpretation fits clearly better, else None.
        can_judge: whether the views show enough in common to find a mistake; if not, a warning says so.
        warnings: on other implausible input.
    """

    name: str
    baseline: float
    error: float
    errors: dict[str, float]
    indistinguishable: tuple[str, ...]
    likely_mistake: str | None
    can_judge: bool
    warnings: tuple[str, ...]

    @property
    def similar(self) -> tuple[str, ...]:
        """Other interpretations that fit about as well as the poses as given, or better."""
        return tuple(r for r, error in self.errors.items() if r != AS_GIVEN and error <= _SIMILAR_RATIO * self.error)


def check_pair(pair: PanoramaSet) -> PoseCheck:
    """Check the poses of a pair's context views against their images; takes seconds."""
    if len(pair.context) < 2:
        raise InputError(
            f"{pair.name}: needed two or more views to check their poses, got one; choose another pair, or state poses."
        )
    return check_views(pair.load_context(_HEIGHT), pair.name)


def check_views(views: Views, name: str = "views") -> PoseCheck:
    """`check_pair` for loaded views; a height of about 64 pixels is enough.

    Args:
        views: two or more; consecutive views are compared.
        name: for the report.
    """
    features = torch.stack([_compute_features(image) for image in views.images])
    poses = views.cam2world
    relatives = {interpretation: _relative_poses(poses, interpretation) for interpretation in (AS_GIVEN, *_ADVICE)}
    given = relatives[AS_GIVEN]
    indistinguishable = [r for r in _ADVICE if _have_same_motion(relatives[r], given)]
    errors: dict[str, float] = {}
    for interpretation, relative in relatives.items():
        if interpretation in indistinguishable:
            continue
        equal = next((r for r in errors if _have_same_motion(relatives[r], relative)), None)
        errors[interpretation] = errors[equal] if equal else _photometric_error(features, views, relative)
    errors = dict(sorted(errors.items(), key=lambda item: item[1]))
    centres = poses[:, :3, 3]
    baseline = max(float((a - b).norm()) for a, b in itertools.combinations(centres, 2))
    can_judge = _can_judge(errors)
    warnings = _list_warnings(centres, baseline, views)
    if not can_judge:
        warnings += (
            "the check cannot judge these poses, because no interpretation fits clearly (lowest error "
            f"{next(iter(errors.values())):.3f}): the views have too little in common for it, as cameras some metres "
            "apart have. If they are near each other in one room, the poses or the order of the images are wrong.",
        )
    mistake = _describe_mistake(errors)
    return PoseCheck(name, baseline, errors[AS_GIVEN], errors, tuple(indistinguishable), mistake, can_judge, warnings)


def _can_judge(errors: dict[str, float]) -> bool:
    """Whether the best interpretation, which comes first, fits well enough to be the right one."""
    best = next(iter(errors.values()))
    is_distinct = best <= _DISTINCT_RATIO * statistics.median(set(errors.values()))
    if _as_given_is_worse(errors):
        return is_distinct and best <= _MAX_ERROR
    return is_distinct or best <= _NO_OVERLAP


def _as_given_is_worse(errors: dict[str, float]) -> bool:
    """Whether the poses as given fit significantly worse than the best interpretation."""
    best = next(iter(errors.values()))
    return best <= min(_MAX_RATIO * errors[AS_GIVEN], errors[AS_GIVEN] - _MIN_DIFFERENCE)


def _describe_mistake(errors: dict[str, float]) -> str | None:
    """Advice for the best interpretation, and for equally good ones, if it is clearly better than as given."""
    if not (_as_given_is_worse(errors) and _can_judge(errors)):
        return None
    best = next(iter(errors.values()))
    named = [_ADVICE[r] for r, error in errors.items() if r != AS_GIVEN and error <= best * 1.001]
    return "; or ".join(named) + f" (error {best:.3f} instead of {errors[AS_GIVEN]:.3f})."


def _list_warnings(centres: Float[Tensor, "view 3"], baseline: float, views: Views) -> tuple[str, ...]:
    """Warnings on the distances between the cameras."""
    warnings = []
    closest = min(float((a - b).norm()) for a, b in itertools.combinations(centres, 2))
    if baseline > 0.5 * views.far:
        warnings.append(
            f"the cameras are {baseline:.3g} m apart, which is large against far = {views.far:g} m: "
            "are the poses in centimetres or millimetres? Convert them to metres, or set near and far to fit."
        )
    if closest < 0.02 * views.near:
        degrees = math.degrees(math.atan2(closest, views.near))
        warnings.append(
            f"two cameras are only {closest:.3g} m apart: even at near = {views.near:g} m the parallax is "
            f"{degrees:.2g} degrees, so depth cannot be measured. Check the unit of the poses, or set "
            "near and far to fit."
        )
    return tuple(warnings)


def _relative_poses(cam2world: Float[Tensor, "view 4 4"], interpretation: str) -> Float[Tensor, "pair 4 4"]:
    """Poses of each view in the next one's camera, under an interpretation of the given matrices."""
    poses = _interpret_poses(cam2world, interpretation)
    return torch.linalg.solve(poses[1:], poses[:-1])


_CAMERA_AXES = {  # OpenCV camera axes, as columns, in the stated camera axes
    "opengl axes": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z-up camera": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x-forward camera": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "turned by 90 degrees": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "turned by 180 degrees": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "turned by -90 degrees": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
}


def _interpret_poses(poses: Float[Tensor, "view 4 4"], interpretation: str) -> Float[Tensor, "view 4 4"]:
    """The OpenCV cam2world poses that a mistake turned into the given matrices."""
    if interpretation == "transposed rotation":
        transposed = poses.clone()
        transposed[:, :3, :3] = poses[:, :3, :3].transpose(-1, -2)
        return transposed
    if interpretation == "swapped views":
        return poses.flip(0)
    if interpretation.startswith("mirrored"):
        axis = ("left-right", "up-down", "front-back").index(interpretation.split()[1])
        mirror = torch.eye(4, dtype=poses.dtype)
        mirror[axis, axis] = -1
        return mirror @ poses @ mirror
    if interpretation.startswith("inverse"):
        poses = invert_pose(poses)
    axes = _CAMERA_AXES.get(interpretation.removeprefix("inverse, "))
    if axes is None:
        return poses
    rotation = torch.eye(4, dtype=poses.dtype)
    rotation[:3, :3] = torch.tensor(axes, dtype=poses.dtype)
    return poses @ rotation


def _have_same_motion(first: Float[Tensor, "pair 4 4"], second: Float[Tensor, "pair 4 4"]) -> bool:
    """Whether two interpretations have the same relative poses within the tolerance of a small image."""
    length = second[:, :3, 3].norm(dim=-1).clamp_min(1e-9)
    rotation = (first - second)[:, :3, :3].abs().max()
    translation = ((first - second)[:, :3, 3].norm(dim=-1) / length).max()
    return bool(rotation < _SAME_POSE and translation < _SAME_POSE)


def _compute_features(image: Float[Tensor, "3 height width"]) -> Float[Tensor, "feature height width"]:
    """Colour, and locally normalised brightness and gradients, which are robust against exposure."""
    padded = pad_equirect(image.mean(dim=0), 4)
    box = torch.nn.functional.avg_pool2d(padded[None, None], 9, stride=1)[0, 0]
    squares = torch.nn.functional.avg_pool2d(padded[None, None] ** 2, 9, stride=1)[0, 0]
    deviation = (squares - box * box).clamp_min(0).sqrt() + 0.03
    dx = (padded[4:-4, 5:-3] - padded[4:-4, 3:-5]) / (2 * deviation)
    dy = (padded[5:-3, 4:-4] - padded[3:-5, 4:-4]) / (2 * deviation)
    normalised = (image.mean(dim=0) - box) / (2 * deviation)
    return torch.stack((*(image * 1.5), normalised, dx, dy))


def _photometric_error(
    features: Float[Tensor, "view feature height width"], views: Views, relative: Float[Tensor, "pair 4 4"]
) -> float:
    """Mean over both directions of all pairs of consecutive views."""
    total = []
    for i, motion in enumerate(relative):
        for a, b, pose in ((i, i + 1, motion), (i + 1, i, torch.linalg.inv(motion))):
            total.append(_sweep_error(features[a], features[b], views.masks[a], views.masks[b], pose, views))
    return sum(total) / len(total)


def _sweep_error(
    reference: Float[Tensor, "feature height width"],
    other: Float[Tensor, "feature height width"],
    mask: Bool[Tensor, "height width"],
    other_mask: Bool[Tensor, "height width"],
    pose: Float[Tensor, "4 4"],
    views: Views,
) -> float:
    """Mean over the sphere of the lowest aggregated difference over all depths; about 1 for unrelated images."""
    height, width = reference.shape[-2:]
    inverse = torch.linspace(1 / views.far, 1 / views.near, _CANDIDATES)
    rays = pixel_directions(height, width) @ pose[:3, :3].T.float()
    points = rays + inverse[:, None, None, None] * pose[:3, 3].float()  # divided by the depth: only directions matter
    size = torch.tensor((width, height), dtype=torch.float32)
    grid = 2 * (uv_from_directions(points) * size + 1) / (size + 2) - 1
    source = pad_equirect(torch.cat((other, other_mask[None].to(other.dtype))), 1)
    warped = torch.nn.functional.grid_sample(
        source.expand(_CANDIDATES, -1, -1, -1), grid, padding_mode="border", align_corners=False
    )
    difference = (warped[:, :-1] - reference).abs().clamp_max(_DIFFERENCE_CAP).mean(dim=1)
    visible = (warped[:, -1] > 0.5) & mask
    difference = torch.where(visible, difference, torch.full_like(difference, _DIFFERENCE_CAP / 2))
    window = 2 * _WINDOW_RADIUS + 1
    padded = pad_equirect(difference, _WINDOW_RADIUS)[:, None]
    lowest = torch.nn.functional.avg_pool2d(padded, window, stride=1)[:, 0].amin(dim=0)
    weights = row_weights(height, dtype=lowest.dtype)[:, None] * mask
    return float((lowest * weights).sum() / weights.sum().clamp_min(1e-9)) / (_DIFFERENCE_CAP / 2)
