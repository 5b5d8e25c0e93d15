"""The interactive camera (yaw, pitch, orbit), and the pinhole cameras of images and cube faces.

Pure functions without window or GL.

Convention: poses are cam2world, OpenCV axes (x right, y down, z forward), metres. Positive yaw turns right, positive
pitch turns up. Both are relative to `level`, an upright frame of the scene.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pansplat.constants import FILTER_VARIANCE, MAX_FOV_DEGREES, MAX_PITCH_DEGREES, MIN_FOV_DEGREES
from pansplat.geometry.cubemap import face_rotations
from pansplat.geometry.level import turn_axes

MAX_PITCH_RADIANS = math.radians(MAX_PITCH_DEGREES)
MIN_DISTANCE = 0.05  # metres, from the orbit centre


@dataclass(frozen=True)
class Camera:
    """The interactive camera: position, viewing direction and field of view.

    Attributes:
        level: columns are right, down and forward of a camera with yaw and pitch 0, in world axes.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # centre in the world, metres
    yaw_radians: float = 0.0  # heading, to the right of the forward axis of `level`
    pitch_radians: float = 0.0  # angle above the horizon
    vertical_fov_degrees: float = 75.0  # vertical field of view
    level: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    distance: float = 2.0  # from the camera to the orbit centre ahead, metres

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The camera axes in the world (columns right, down, forward), without roll."""
        return turn_axes(np.asarray(self.level), self.yaw_radians, self.pitch_radians)

    @property
    def cam2world(self) -> Float[np.ndarray, "4 4"]:
        """The camera-to-world matrix of the camera, OpenCV axes, metres."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.position
        return matrix

    @property
    def orbit_center(self) -> Float[np.ndarray, "3"]:
        """The orbit centre, metres."""
        return np.asarray(self.position) + self.distance * self.rotation[:, 2]

    def find_focal(self, height: int) -> float:
        """The focal length of an image with this height, pixels."""
        return 0.5 * height / math.tan(math.radians(self.vertical_fov_degrees) / 2)


def move_to_pose(camera: Camera, cam2world: Float[np.ndarray, "4 4"]) -> Camera:
    """Move the camera to the position and viewing direction of a pose; the roll of the pose is dropped."""
    local = np.asarray(camera.level).T @ cam2world[:3, :3]
    right, forward = local[:, 0], local[:, 2]
    pitch = math.asin(_clamp(-float(forward[1]), 1.0))
    if math.hypot(forward[0], forward[2]) > 1e-6:
        yaw = math.atan2(forward[0], forward[2])
    else:  # straight up or down: the heading follows from the right axis
        yaw = math.atan2(-right[2], right[0])
    pitch = _clamp(pitch, MAX_PITCH_RADIANS)
    return replace(camera, position=_triple(cam2world[:3, 3]), yaw_radians=yaw, pitch_radians=pitch)


def turn(camera: Camera, yaw_radians: float, pitch_radians: float) -> Camera:
    """Turn the camera right by yaw and up by pitch; the pitch stays within MAX_PITCH_RADIANS."""
    yaw = math.remainder(camera.yaw_radians + yaw_radians, 2 * math.pi)
    pitch = _clamp(camera.pitch_radians + pitch_radians, MAX_PITCH_RADIANS)
    return replace(camera, yaw_radians=yaw, pitch_radians=pitch)


def turn_by_drag(camera: Camera, pixels: tuple[float, float], height: int) -> Camera:
    """Turn so that the scene follows a pointer that moved by `pixels` (right, down); `height` is the window's."""
    radians_per_pixel = 1 / camera.find_focal(max(height, 1))
    return turn(camera, -pixels[0] * radians_per_pixel, pixels[1] * radians_per_pixel)


def fly(camera: Camera, right: float, up: float, forward: float) -> Camera:
    """Move by metres along the camera's right and forward axes and along the scene's up axis."""
    axes = camera.rotation
    step = right * axes[:, 0] + forward * axes[:, 2] - up * np.asarray(camera.level)[:, 1]
    return replace(camera, position=_triple(np.asarray(camera.position) + step))


def orbit(camera: Camera, pixels: tuple[float, float], height: int) -> Camera:
    """Turn around the orbit centre; a drag over the window's height is half a turn."""
    radians_per_pixel = math.pi / max(height, 1)
    center = camera.orbit_center
    turned = turn(camera, pixels[0] * radians_per_pixel, -pixels[1] * radians_per_pixel)
    return replace(turned, position=_triple(center - camera.distance * turned.rotation[:, 2]))


def dolly(camera: Camera, steps: float) -> Camera:
    """Move towards (positive) or away from the orbit centre by 10% of the distance per step."""
    center = camera.orbit_center
    distance = max(camera.distance * 0.9**steps, MIN_DISTANCE)
    return replace(camera, distance=distance, position=_triple(center - distance * camera.rotation[:, 2]))


def zoom(camera: Camera, steps: float) -> Camera:
    """Narrow (positive) or widen the field of view by 8% per step."""
    fov = min(max(camera.vertical_fov_degrees * 0.92**steps, MIN_FOV_DEGREES), MAX_FOV_DEGREES)
    return replace(camera, vertical_fov_degrees=fov)


def focus_on_point(camera: Camera, point: Float[np.ndarray, "3"]) -> Camera:
    """Look at a point and make it the orbit centre; a point at the camera's position changes nothing."""
    offset = np.asarray(camera.level).T @ (np.asarray(point) - np.asarray(camera.position))
    distance = float(np.linalg.norm(offset))
    if distance < 1e-6:
        return camera
    yaw = math.atan2(offset[0], offset[2])
    pitch = _clamp(math.asin(_clamp(-offset[1] / distance, 1.0)), MAX_PITCH_RADIANS)
    return replace(camera, yaw_radians=yaw, pitch_radians=pitch, distance=max(distance, MIN_DISTANCE))


def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def _triple(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A pinhole camera with square pixels and the principal point at the image centre.

    Attributes:
        width, height: pixels.
    """

    rotation: Float[np.ndarray, "3 3"]  # camera to world, OpenCV axes
    position: tuple[float, float, float]  # camera centre in the splats' moved frame, metres
    focal: float  # focal length, pixels
    width: int
    height: int

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the image size in image-plane units (z = 1)."""
        return 0.5 * self.width / self.focal, 0.5 * self.height / self.focal

    @property
    def filter_deviation(self) -> float:
        """Standard deviation of the low-pass filter (docs/rendering.md, section 2), in image-plane units."""
        return math.sqrt(FILTER_VARIANCE) / self.focal

    def compute_side_normals(self) -> Float[np.ndarray, "4 3"]:
        """Return the inward unit normals, in world axes, of the view frustum's four sides."""
        x, y = self.half_size
        normals = np.array(((-1, 0, x), (1, 0, x), (0, -1, y), (0, 1, y)), dtype=np.float64)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals @ self.rotation.T


def create_face_cameras(position: tuple[float, float, float], face_size: int, border: int) -> list[Pinhole]:
    """Return the six face cameras of a cube along the world's axes, with `border` extra pixels a side."""
    side = face_size + 2 * border
    rotations = face_rotations().numpy()
    return [Pinhole(face, position, 0.5 * face_size, side, side) for face in rotations]


def find_faces_in_view(camera_to_faces: Float[np.ndarray, "3 3"], half_size: tuple[float, float]) -> list[int]:
    """Return the cube faces that a pinhole image with this half size (image-plane units) reads."""
    x, y = (np.linspace(-half, half, 65) for half in half_size)
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1).reshape(-1, 3) @ camera_to_faces.T
    faces = []
    for face, rotation in enumerate(face_rotations().numpy()):
        local = rays @ rotation
        # A margin of 10% covers directions between the rays of this coarse grid.
        if (np.abs(local[:, :2]).max(axis=1) <= 1.1 * local[:, 2]).any():
            faces.append(face)
    return faces
