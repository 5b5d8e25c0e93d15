"""Pinhole cameras as the shaders take them: what they see, and the six that make a panorama."""

from __future__ import annotations

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
    orientation: Float[np.ndarray, "3 3"], position: tuple[float, float, float], face_size: int
) -> list[Pinhole]:
    """The six faces of a cube whose axes are `orientation` (to world), in the order of geometry/cubemap.py."""
    rotations = face_rotations().numpy()
    return [
        Pinhole(orientation @ face, position, 0.5 * face_size, face_size, face_size) for face in rotations
    ]


def faces_in_sight(
    camera_to_faces: Float[np.ndarray, "3 3"], half_size: tuple[float, float], face_size: int
) -> list[int]:
    """The faces a pinhole picture looks up, neighbours of a bilinear sample at an edge included."""
    x, y = (np.linspace(-half, half, 65) for half in half_size)
    grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1).reshape(-1, 3)
    local = (grid @ camera_to_faces.T) @ face_rotations().numpy().transpose(1, 0, 2).reshape(3, -1)
    local = local.reshape(-1, 3, NUM_FACES, 3) if local.ndim == 4 else local.reshape(-1, NUM_FACES, 3)
    # The grid is coarse and a sample may touch the neighbour's first pixel: count a little more than the face.
    reach = 1 + max(4 / face_size, 0.2)
    depth = local[..., 2]
    inside = (depth > 0) & (np.abs(local[..., :2]).max(axis=-1) <= reach * depth)
    return [int(face) for face in np.flatnonzero(inside.any(axis=0))]


def in_sight(
    camera: Pinhole, ordering: Ordering, keep: Bool[np.ndarray, "n"], *, kernel: str, filter_variance: float
) -> Bool[np.ndarray, "n"]:
    """Which of the kept splats can touch the picture; may keep more than needed, never less.

    A splat is a ball of its reach in standard deviations, widened by the filter. The linearised kernel `ewa` draws
    outside that ball, so there only splats behind the camera are left out.
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
