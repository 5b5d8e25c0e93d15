"""Camera paths between the input panoramas.

Poses are cam2world, 4x4 float64, OpenCV axes, metres. A level pose has no roll and no pitch relative to the common up
direction of the cameras.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.geometry.pose import interpolate_poses

_MIN_STEP = 1e-6  # metres; a shorter step has no direction
_EXCURSION_DIAMETER = 0.4  # metres; a single camera flies on a circle of this diameter
_TURN = math.radians(40)  # largest turn of a flight to each side


def ease_in_out(fraction: float) -> float:
    """Smooth start and stop: monotonic from 0 to 1, without velocity or acceleration at either end."""
    t = min(max(fraction, 0.0), 1.0)
    return t * t * t * (t * (6 * t - 15) + 10)


def up_direction(cam2world: Float[Tensor, "view 4 4"]) -> Float[Tensor, "3"]:
    """Unit world direction of the mean of the cameras' -y axes; -y without cameras."""
    up = -cam2world[:, :3, 1].double().sum(0)
    if len(cam2world) == 0 or float(up.norm()) < 1e-3:
        up = torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64)
    return up / up.norm()


def look_pose(
    position: Float[Tensor, "3"], forward: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "4 4"]:
    """Pose at `position` that looks along `forward`; `up` is vertical in the image.

    Raises:
        ValueError: when `forward` is (nearly) parallel to `up` or has no length.
    """
    forward, up = forward.double(), up.double()
    right = torch.linalg.cross(forward, up)
    if float(right.norm()) < 1e-6 * max(float(forward.norm() * up.norm()), 1e-30) or float(forward.norm()) == 0:
        raise ValueError(f"`forward` {forward.tolist()} must not be parallel to `up` {up.tolist()}")
    right = right / right.norm()
    forward = forward / forward.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 0] = right
    pose[:3, 1] = torch.linalg.cross(forward, right)
    pose[:3, 2] = forward
    pose[:3, 3] = position.double()
    return pose


def level_pose(cam2world: Float[Tensor, "4 4"], up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """The pose with the same position and heading, without roll or pitch; a vertical view is allowed."""
    pose = cam2world.double()
    forward, up = pose[:3, 2], up.double() / up.double().norm()
    flat = forward - (forward @ up) * up
    if float(flat.norm()) < 1e-3:
        flat = torch.sign(forward @ up) * pose[:3, 1]
        flat = flat - (flat @ up) * up
    return look_pose(pose[:3, 3], flat, up)


def turn_axes(level: Float[np.ndarray, "3 3"], yaw_radians: float, pitch_radians: float) -> Float[np.ndarray, "3 3"]:
    """Axes of a camera (columns right, down, forward) that is turned right and up from level axes, without roll."""
    cy, sy, cp, sp = math.cos(yaw_radians), math.sin(yaw_radians), math.cos(pitch_radians), math.sin(pitch_radians)
    return level @ np.array(((cy, 0, sy), (0, 1, 0), (-sy, 0, cy))) @ np.array(((1, 0, 0), (0, cp, -sp), (0, sp, cp)))


def turn_pose(pose: Float[Tensor, "4 4"], yaw_radians: float, up: Float[Tensor, "3"]) -> Float[Tensor, "4 4"]:
    """The pose rotated about `up`; positive yaw turns the view to the right."""
    axis = -up.double() / up.double().norm()  # down: with y down, right turns z towards x
    x, y, z = axis.tolist()
    cross = torch.tensor(((0, -z, y), (z, 0, -x), (-y, x, 0)), dtype=torch.float64)
    rotation = (
        math.cos(yaw_radians) * torch.eye(3, dtype=torch.float64)
        + math.sin(yaw_radians) * cross
        + (1 - math.cos(yaw_radians)) * torch.outer(axis, axis)
    )
    turned = pose.double().clone()
    turned[:3, :3] = rotation @ turned[:3, :3]
    return turned


def find_direction(cam2world: Float[Tensor, "4 4"], yaw: float, pitch: float) -> Float[Tensor, "3"]:
    """The unit direction, in world axes, of angles in a panorama: right of its centre, below its horizon, radians."""
    local = math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)
    return cam2world[:3, :3].double() @ torch.tensor(local, dtype=torch.float64)


def wrap_angle(angle: float) -> float:
    """The same direction within half a turn, radians."""
    return math.remainder(angle, 2 * math.pi)


def path_poses(cam2world: Float[Tensor, "view 4 4"]) -> Float[Tensor, "view 4 4"]:
    """A level pose at each camera that looks along the path.

    The path's direction at a camera is the direction from its predecessor to its successor. Without a direction (one
    camera, coincident cameras, a vertical path) the pose keeps the camera's heading.
    """
    up = up_direction(cam2world)
    positions = cam2world[:, :3, 3].double()
    last = len(cam2world) - 1
    poses = []
    for view, pose in enumerate(cam2world.double()):
        along = positions[min(view + 1, last)] - positions[max(view - 1, 0)]
        flat = along - (along @ up) * up
        if float(flat.norm()) < max(_MIN_STEP, 1e-3 * float(along.norm())):
            poses.append(level_pose(pose, up))
        else:
            poses.append(look_pose(pose[:3, 3], flat, up))
    return torch.stack(poses) if poses else torch.zeros((0, 4, 4), dtype=torch.float64)


def level_axes(cam2world: Float[Tensor, "view 4 4"]) -> Float[np.ndarray, "3 3"]:
    """Axes of a level camera at the first of the cameras, in the direction of the path; without cameras those of +z."""
    if len(cam2world):
        return path_poses(cam2world)[0, :3, :3].numpy()
    forward = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    return look_pose(torch.zeros(3), forward, up_direction(cam2world))[:3, :3].numpy()


def fly_pose(cam2world: Float[Tensor, "view 4 4"], fraction: float) -> Float[Tensor, "4 4"]:
    """Pose at a fraction of a flight through all cameras.

    The camera starts and stops smoothly. It looks along the path and turns slowly to the left and then to the right, so
    that parallax is visible; at both ends and in the middle it looks straight ahead. With a single camera, it flies a
    level circle through it and a place 0.4 m ahead.

    Args:
        cam2world: the cameras in the order of the flight; at least one.
        fraction: time from 0 (first camera) to 1 (last camera); clamped.

    Raises:
        ValueError: without any camera.
    """
    if len(cam2world) == 0:
        raise ValueError("`cam2world` must hold at least one camera to fly from, got none")
    eased = ease_in_out(fraction)
    up = up_direction(cam2world)
    pose = _interpolate_path(path_poses(cam2world), eased)
    if len(cam2world) == 1:
        angle = 2 * math.pi * eased
        pose = pose.clone()
        pose[:3, 3] += 0.5 * _EXCURSION_DIAMETER * ((1 - math.cos(angle)) * pose[:3, 2] - math.sin(angle) * pose[:3, 0])
    # The turn depends on the eased fraction, so that it also starts and stops smoothly.
    return turn_pose(pose, -_TURN * math.sin(2 * math.pi * eased), up)


def _interpolate_path(poses: Float[Tensor, "stop 4 4"], fraction: float) -> Float[Tensor, "4 4"]:
    """Pose at a fraction of the polyline's length, or of the number of stops where the length is zero."""
    if len(poses) == 1:
        return poses[0]
    steps = (poses[1:, :3, 3] - poses[:-1, :3, 3]).norm(dim=-1)
    if float(steps.sum()) < _MIN_STEP:
        steps = torch.ones_like(steps)
    ends = torch.cumsum(steps, 0) / steps.sum()
    leg = min(int(torch.searchsorted(ends, fraction)), len(steps) - 1)
    start = float(ends[leg - 1]) if leg else 0.0
    length = float(ends[leg]) - start
    within = (fraction - start) / length if length > 0 else 1.0
    return interpolate_poses(poses[leg], poses[leg + 1], min(max(within, 0.0), 1.0))
