"""The camera that a person steers: level flight, looking around, orbiting. Pure arithmetic, no window, no GL.

Convention: poses are cam2world, OpenCV axes (x right, y down, z forward), metres. Yaw turns to the right,
pitch up; both are relative to `level`, an upright frame of the scene.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

MAX_PITCH_RADIANS = math.radians(89.9)
MIN_FOV_DEGREES, MAX_FOV_DEGREES = 15.0, 130.0
MIN_DISTANCE = 0.05  # metres from an orbit's centre


@dataclass(frozen=True)
class Camera:
    """Where the camera is and where it looks.

    Attributes:
        position: centre in the world, metres.
        yaw_radians: heading, to the right of `level`'s forward axis.
        pitch_radians: above the horizon.
        vertical_fov_degrees: vertical field of view.
        level: columns are the right, down and forward of a level camera with yaw and pitch 0, in world axes.
        distance: how far ahead the centre of an orbit lies, metres.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_radians: float = 0.0
    pitch_radians: float = 0.0
    vertical_fov_degrees: float = 75.0
    level: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    distance: float = 2.0


def rotation(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Camera axes in the world (columns right, down, forward); never rolled."""
    cy, sy = math.cos(camera.yaw_radians), math.sin(camera.yaw_radians)
    cp, sp = math.cos(camera.pitch_radians), math.sin(camera.pitch_radians)
    yaw = np.array(((cy, 0, sy), (0, 1, 0), (-sy, 0, cy)))
    pitch = np.array(((1, 0, 0), (0, cp, -sp), (0, sp, cp)))
    return np.asarray(camera.level) @ yaw @ pitch


def pose(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """The camera's cam2world."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(camera)
    matrix[:3, 3] = camera.position
    return matrix


def place(camera: Camera, cam2world: Float[np.ndarray, "4 4"]) -> Camera:
    """The camera moved to a pose's place and viewing direction; a roll of the pose is dropped."""
    local = np.asarray(camera.level).T @ cam2world[:3, :3]
    right, forward = local[:, 0], local[:, 2]
    pitch = math.asin(min(max(-float(forward[1]), -1.0), 1.0))
    if math.hypot(forward[0], forward[2]) > 1e-6:
        yaw = math.atan2(forward[0], forward[2])
    else:  # straight up or down: the image's right still tells the heading
        yaw = math.atan2(-right[2], right[0])
    return replace(
        camera,
        position=_triple(cam2world[:3, 3]),
        yaw_radians=yaw,
        pitch_radians=_clamp(pitch, MAX_PITCH_RADIANS),
    )


def look(camera: Camera, yaw_radians: float, pitch_radians: float) -> Camera:
    """The camera turned in place: positive yaw to the right, positive pitch up (stops short of the poles)."""
    yaw = math.remainder(camera.yaw_radians + yaw_radians, 2 * math.pi)
    return replace(
        camera,
        yaw_radians=yaw,
        pitch_radians=_clamp(camera.pitch_radians + pitch_radians, MAX_PITCH_RADIANS),
    )


def drag_look(camera: Camera, pixels: tuple[float, float], height: int) -> Camera:
    """Turn so that the scene sticks to a pointer that moved by `pixels` (right, down)."""
    radians_a_pixel = 2 * math.tan(math.radians(camera.vertical_fov_degrees) / 2) / max(height, 1)
    return look(camera, -pixels[0] * radians_a_pixel, pixels[1] * radians_a_pixel)


def fly(camera: Camera, right: float, up: float, forward: float) -> Camera:
    """The camera moved by metres along its own right and forward axes, and along the scene's up."""
    axes = rotation(camera)
    step = right * axes[:, 0] + forward * axes[:, 2] - up * np.asarray(camera.level)[:, 1]
    return replace(camera, position=_triple(np.asarray(camera.position) + step))


def orbit_center(camera: Camera) -> Float[np.ndarray, "3"]:
    """The point that an orbit turns around, metres."""
    return np.asarray(camera.position) + camera.distance * rotation(camera)[:, 2]


def orbit(camera: Camera, pixels: tuple[float, float], height: int) -> Camera:
    """Turn around the point ahead: half a turn for a drag over the window's height."""
    radians_a_pixel = math.pi / max(height, 1)
    center = orbit_center(camera)
    turned = look(camera, pixels[0] * radians_a_pixel, -pixels[1] * radians_a_pixel)
    return replace(turned, position=_triple(center - camera.distance * rotation(turned)[:, 2]))


def dolly(camera: Camera, steps: float) -> Camera:
    """Move towards (positive) or away from the orbit's centre by 10% of the distance a step."""
    center = orbit_center(camera)
    distance = max(camera.distance * 0.9**steps, MIN_DISTANCE)
    position = center - distance * rotation(camera)[:, 2]
    return replace(camera, distance=distance, position=_triple(position))


def zoom(camera: Camera, steps: float) -> Camera:
    """Narrow (positive) or widen the field of view by 8% a step."""
    fov = min(max(camera.vertical_fov_degrees * 0.92**steps, MIN_FOV_DEGREES), MAX_FOV_DEGREES)
    return replace(camera, vertical_fov_degrees=fov)


def focus(camera: Camera, point: Float[np.ndarray, "3"]) -> Camera:
    """Look at a point and make it the centre of orbits; a point at the camera changes nothing."""
    offset = np.asarray(camera.level).T @ (np.asarray(point) - np.asarray(camera.position))
    distance = float(np.linalg.norm(offset))
    if distance < 1e-6:
        return camera
    turned = replace(
        camera,
        yaw_radians=math.atan2(offset[0], offset[2]),
        pitch_radians=_clamp(math.asin(min(max(-offset[1] / distance, -1.0), 1.0)), MAX_PITCH_RADIANS),
    )
    return replace(turned, distance=max(distance, MIN_DISTANCE))


def nearest_view(camera: Camera, cam2world: Float[np.ndarray, "view 4 4"]) -> int:
    """Index of the input camera nearest to the camera's position; the first on ties."""
    offsets = cam2world[:, :3, 3] - np.asarray(camera.position)
    return int(np.argmin(np.linalg.norm(offsets, axis=1)))


def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def _triple(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
