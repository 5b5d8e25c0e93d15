"""The point of a scene under the pointer, and its distance."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pansplat_viewer.core.camera import Camera
from pansplat_viewer.core.settings import DrawSettings
from pansplat_viewer.draw.frame_renderer import FrameRenderer, render_image

_SIZE, _FOV_DEGREES = 3, 0.3  # side of the image around a ray, pixels, and its field of view


@dataclass(frozen=True)
class PickedPoint:
    """A point on the surface that one pixel shows."""

    position: tuple[float, float, float]  # in the world, metres
    depth: float  # radial distance from the camera, metres: the mean of the Gaussians on the ray, by weight


def compute_pixel_ray(
    camera: Camera, pixel: tuple[float, float], size: tuple[int, int]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return origin and unit direction, in the world, of the ray through a pixel (from the left, from the top)."""
    (width, height), focal = size, camera.find_focal(size[1])
    ray = np.array(((pixel[0] - 0.5 * width) / focal, (pixel[1] - 0.5 * height) / focal, 1.0))
    direction = camera.rotation @ ray
    return np.asarray(camera.position), direction / np.linalg.norm(direction)


def project_point(
    camera: Camera, point: tuple[float, float, float], size: tuple[int, int]
) -> tuple[float, float] | None:
    """Return the pixel (from the left, from the top) of a world point; None if it is not ahead of the camera."""
    (width, height), focal = size, camera.find_focal(size[1])
    x, y, z = camera.rotation.T @ (np.asarray(point) - np.asarray(camera.position))
    if z <= 0:
        return None
    return float(focal * x / z + 0.5 * width), float(focal * y / z + 0.5 * height)


def pick_point(
    renderer: FrameRenderer,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    settings: DrawSettings,
) -> PickedPoint | None:
    """Return the point that a renderer draws on a ray, by a small image around it; None if it draws nothing there."""
    pose = np.eye(4)
    pose[:3, 0] = np.cross(np.eye(3)[np.abs(direction).argmin()], direction)  # an axis that is not along the ray
    pose[:3, 0] /= np.linalg.norm(pose[:3, 0])
    pose[:3, 1], pose[:3, 2], pose[:3, 3] = np.cross(direction, pose[:3, 0]), direction, origin
    settings = replace(settings, scale=1.0, vertical_fov_degrees=_FOV_DEGREES)
    _, depths = render_image(renderer, pose, (_SIZE, _SIZE), settings, with_depth=True)
    assert depths is not None
    depth = float(depths[_SIZE // 2, _SIZE // 2])
    x, y, z = (origin + depth * direction).tolist()
    return PickedPoint((x, y, z), depth) if depth > 0 else None
