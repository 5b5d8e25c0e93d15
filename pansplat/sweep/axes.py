"""The scene's axes.

Rooms consist of horizontal planes and of two directions of vertical ones (a Manhattan world). The axes follow from
image gradients: a straight line and the camera span a plane, whose normal is the gradient's direction on the sphere,
and the line's direction is perpendicular to this normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from pansplat.sweep.panoramas import pad_sphere, ray_grid

_MIN_GRADIENT = 0.02  # per pixel; smaller gradients are noise
_MAX_GRADIENT = 0.2  # larger gradients have the weight of this one


def estimate_axes(images: Sequence[np.ndarray], rotations: Sequence[np.ndarray]) -> np.ndarray:
    """Orthonormal world axes of the scene, as rows: down, and the two main wall normals.

    Down starts at the mean of the cameras' y axes and is fitted to the vertical edges. The walls' yaw is the peak of
    the histogram of horizontal edges, modulo a quarter turn. Without edges the axes are still orthonormal.

    Args:
        images: panoramas (h, w, 3) in [0, 1], about 256 pixels high.
        rotations: camera-to-world rotations (3, 3) of the same views.
    """
    normals, weights = [], []
    for image, rotation in zip(images, rotations, strict=True):
        normal, weight = _edge_normals(image)
        normals.append(normal @ rotation.T)
        weights.append(weight)
    normal, weight = np.concatenate(normals), np.concatenate(weights)
    down = _fit_down(normal, weight, np.sum([rotation[:, 1] for rotation in rotations], axis=0))
    helper = np.eye(3)[np.abs(down).argmin()]
    a = np.cross(down, helper)
    a /= np.linalg.norm(a)
    b = np.cross(down, a)
    yaw = _fit_yaw(normal, weight, down, a, b)
    return np.stack((down, math.cos(yaw) * a + math.sin(yaw) * b, -math.sin(yaw) * a + math.cos(yaw) * b))


def match_axes(axes: np.ndarray, reference: np.ndarray) -> list[int]:
    """The order in which the walls' axes of `estimate_axes` are those of a reference."""
    return [0, 1, 2] if abs(axes[1] @ reference[1]) >= abs(axes[2] @ reference[1]) else [0, 2, 1]


def _edge_normals(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals (n, 3) of the planes through the camera and an image edge, and their weights (n)."""
    height, width = image.shape[:2]
    margin = 8
    gray = cv2.GaussianBlur(pad_sphere(image.mean(axis=2), margin), (0, 0), 1.0)
    along_v, along_u = np.gradient(gray)
    along_u, along_v = (g[margin:-margin, margin:-margin] for g in (along_u, along_v))
    latitude = ((np.arange(height) + 0.5) / height - 0.5)[:, None] * math.pi
    longitude = ((np.arange(width) + 0.5) / width - 0.5)[None, :] * 2 * math.pi
    ones = np.ones((height, width))
    east = np.stack((np.cos(longitude) * ones, 0 * ones, -np.sin(longitude) * ones), axis=-1)
    south = np.stack(
        (-np.sin(latitude) * np.sin(longitude), np.cos(latitude) * ones, -np.sin(latitude) * np.cos(longitude)), axis=-1
    )
    stretch = np.maximum(np.cos(latitude), 0.05)  # width of a pixel relative to the horizon
    normal = (along_u / stretch)[..., None] * east + along_v[..., None] * south
    length = np.linalg.norm(normal, axis=-1)
    strong = length > _MIN_GRADIENT
    weight = np.minimum(length, _MAX_GRADIENT) * np.cos(latitude)
    return normal[strong] / length[strong][:, None], weight[strong]


def _fit_down(normal: np.ndarray, weight: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The common direction of the vertical edges' planes, near `start`."""
    norm = np.linalg.norm(start)
    down = start / norm if norm > 1e-6 else np.array((0.0, 1.0, 0.0))
    for tolerance_degrees in (10, 6, 4, 3, 2, 2, 2):
        vertical = np.abs(normal @ down) < math.sin(math.radians(tolerance_degrees))
        if vertical.sum() < 100:
            return down
        chosen = normal[vertical]
        eigenvector = np.linalg.eigh((chosen * weight[vertical, None]).T @ chosen)[1][:, 0]
        eigenvector = eigenvector * np.sign(eigenvector @ down)
        if eigenvector @ down < math.cos(math.radians(15)):  # the edges do not constrain the vertical
            return down
        down = eigenvector
    return down


def _fit_yaw(normal: np.ndarray, weight: np.ndarray, down: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Angle in [0, pi/2) from `a` of the most frequent direction of horizontal lines."""
    vertical = np.abs(normal @ down)
    horizontal = (vertical > math.sin(math.radians(8))) & (vertical < math.sin(math.radians(80)))
    angle = np.arctan2(-(normal[horizontal] @ a), normal[horizontal] @ b)
    bins = 180
    votes, _ = np.histogram(angle % (math.pi / 2), bins=bins, range=(0, math.pi / 2), weights=weight[horizontal])
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / 1.5) ** 2)
    smooth = np.convolve(np.concatenate((votes[-4:], votes, votes[:4])), kernel, "valid")
    return (float(smooth.argmax()) + 0.5) / bins * math.pi / 2


def axis_components(axes: np.ndarray, rotation: np.ndarray, height: int) -> np.ndarray:
    """Components (3, height, width) of every pixel's ray along the scene's axes, for a camera's world rotation."""
    return np.moveaxis(ray_grid(height) @ (rotation.T @ axes.T), -1, 0)


def mark_separating_planes(normal: np.ndarray, here: np.ndarray, there: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Planes that separate two cameras, (2, n), of planes at distances 1 / `inverse` on the first one's negative and
    positive side. The cameras see different sides of such a plane.

    Args:
        normal: (3,) of the planes.
        here: (4, 4) pose of the camera.
        there: (4, 4) pose of the other one.
    """
    along = float(normal @ (here[:3, 3] - there[:3, 3]))
    return np.stack([sign * along + 1 / inverse <= 0 for sign in (-1, 1)])
