"""Level cameras, and directions of panoramas.

Poses are cam2world, 4x4 float64, OpenCV axes, metres. A level pose has no roll and no pitch relative to the common up
direction of the cameras.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_MIN_STEP = 1e-6  # metres; a shorter step has no direction


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


def find_direction(cam2world: Float[Tensor, "4 4"], yaw: float, pitch: float) -> Float[Tensor, "3"]:
    """The unit direction, in world axes, of angles in a panorama: right of its centre, below its horizon, radians."""
    local = math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)
    return cam2world[:3, :3].double() @ torch.tensor(local, dtype=torch.float64)


def wrap_angle(angle: float) -> float:
    """The same direction within half a turn, radians."""
    return math.remainder(angle, 2 * math.pi)


def level_axes(cam2world: Float[Tensor, "view 4 4"]) -> Float[np.ndarray, "3 3"]:
    """Axes of a level camera at the first of the cameras; without cameras those that look along +z.

    The camera looks towards the second one. Without a direction (one camera, coincident cameras, a vertical way) it
    keeps the heading of the first.
    """
    up = up_direction(cam2world)
    if len(cam2world) == 0:
        return look_pose(torch.zeros(3), torch.tensor((0.0, 0.0, 1.0)), up)[:3, :3].numpy()
    first = cam2world[0].double()
    along = cam2world[:2, :3, 3].double()[-1] - first[:3, 3]
    flat = along - (along @ up) * up
    if float(flat.norm()) < max(_MIN_STEP, 1e-3 * float(along.norm())):
        return level_pose(first, up)[:3, :3].numpy()
    return look_pose(first[:3, 3], flat, up)[:3, :3].numpy()
