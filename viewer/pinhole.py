"""Pinhole cameras as the shaders take them: what they see, and the six that make a panorama."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pansplat.geometry.cubemap import face_rotations
from pansplat_viewer.order import Ordering

NUM_FACES = 6


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A pinhole camera with square pixels and the principal point in the middle.

    Attributes:
        rotation: camera to world, OpenCV axes.
        position: camera centre in the splats' moved frame, metres.
        focal: focal length, pixels.
        width, height: pixels.
    """

    rotation: Float[np.ndarray, "3 3"]
    position: tuple[float, float, float]
    focal: float
    width: int
    height: int

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the picture in image-plane units (z = 1)."""
        return 0.5 * self.width / self.focal, 0.5 * self.height / self.focal

    def sides(self) -> Float[np.ndarray, "4 3"]:
        """Inward unit normals, in world axes, of the four planes through the eye and the picture's edges."""
        x, y = self.half_size
        normals = np.array(((-1, 0, x), (1, 0, x), (0, -1, y), (0, 1, y)), dtype=np.float64)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals @ self.rotation.T


def focal_of(height: int, vertical_fov_degrees: float) -> float:
    """Focal length in pixels."""
    return 0.5 * height / math.tan(0.5 * math.radians(vertical_fov_degrees))


def face_cameras(
    orientation: Float[np.ndarray, "3 3"], position: tuple[float, float, float], face_size: int, border: int
) -> list[Pinhole]:
    """The six faces of a cube with axes `orientation` (to world), `border` pixels wider than 90 degrees."""
    side = face_size + 2 * border
    rotations = face_rotations().numpy()
    return [Pinhole(orientation @ face, position, 0.5 * face_size, side, side) for face in rotations]


def faces_in_sight(camera_to_faces: Float[np.ndarray, "3 3"], half_size: tuple[float, float]) -> list[int]:
    """The faces that a pinhole picture looks at."""
    x, y = (np.linspace(-half, half, 65) for half in half_size)
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1).reshape(-1, 3) @ camera_to_faces.T
    faces = []
    for face, rotation in enumerate(face_rotations().numpy()):
        local = rays @ rotation
        # The grid is coarse, so count a little more than the face: what is seen may lie between two rays.
        if (np.abs(local[:, :2]).max(axis=1) <= 1.1 * local[:, 2]).any():
            faces.append(face)
    return faces


def in_sight(
    camera: Pinhole, ordering: Ordering, keep: Bool[np.ndarray, "n"], *, kernel: str, filter_variance: float
) -> Bool[np.ndarray, "n"]:
    """Which of the kept splats can touch the picture; may keep more than needed, never less.

    A splat is a ball of its reach in standard deviations, widened by the filter. The linearised kernel `ewa`
    draws outside that ball, so there only splats behind the camera are left out.
    """
    means = ordering.splats.means
    if kernel == "ewa":
        normals, bound = camera.rotation[:, 2][None], np.float32(0)
    else:
        normals = camera.sides()
        moved = math.dist(camera.position, ordering.position)
        spread = np.float32(1.001 * math.sqrt(filter_variance))
        bound = ordering.radius + np.float32(moved)
        bound *= spread * ordering.splats.reach + np.float32(1e-5)
        bound += np.float32(1.001) * ordering.splats.extent
    offsets = normals @ np.asarray(camera.position)
    distances = normals.astype(np.float32) @ means.T
    seen = keep.copy()
    for distance, offset in zip(distances, offsets, strict=True):
        distance += bound
        seen &= distance >= np.float32(offset)
    return seen
