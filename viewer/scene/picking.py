"""The point of a scene under the pointer, and its distance."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from pansplat.constants import ALPHA_CUT, MAX_ALPHA
from pansplat.gaussians.scene import Scene
from pansplat.geometry.pose import rotations_from_quats
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.settings import DrawSettings

_MIN_RELATIVE_SCALE = 1e-6  # of the distance; thinner Gaussians are this thick


@dataclass(frozen=True)
class PickedPoint:
    """A point on the surface that one pixel shows."""

    position: tuple[float, float, float]  # in the world, metres
    depth: float  # radial distance from the camera, metres: the mean of the Gaussians on the ray, by weight


def compute_pixel_ray(
    camera: Camera, pixel: tuple[float, float], size: tuple[int, int]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return origin and unit direction, in the world, of the ray through a pixel (from the left, from the top)."""
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(camera.vertical_fov_degrees) / 2)
    ray = np.array(((pixel[0] - 0.5 * width) / focal, (pixel[1] - 0.5 * height) / focal, 1.0))
    direction = camera.rotation @ ray
    return np.asarray(camera.position), direction / np.linalg.norm(direction)


def project_point(
    camera: Camera, point: tuple[float, float, float], size: tuple[int, int]
) -> tuple[float, float] | None:
    """Return the pixel (from the left, from the top) of a world point; None if it is not ahead of the camera."""
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(camera.vertical_fov_degrees) / 2)
    x, y, z = camera.rotation.T @ (np.asarray(point) - np.asarray(camera.position))
    if z <= 0:
        return None
    return float(focal * x / z + 0.5 * width), float(focal * y / z + 0.5 * height)


def pick_point(
    scene: Scene, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], settings: DrawSettings
) -> PickedPoint | None:
    """Return the point that a ray shows; None if no Gaussian reaches the alpha cut.

    The response is that of the kernel `ray` without the low-pass filter. Levels, opacity threshold and the view of mode
    `view` select Gaussians as they do in the image; other modes count the Gaussians of all views.
    """
    gaussians = scene.gaussians
    offsets = gaussians.means.double().numpy() - origin
    distances = np.linalg.norm(offsets, axis=1)
    along = offsets @ direction
    across = np.sqrt(np.maximum(distances**2 - along**2, 0))
    reach = 3.4 * gaussians.scales.max(dim=1).values.numpy()  # alpha 1 falls to the cut within 3.33 deviations
    near = (across <= reach) & (along > -reach) & (distances >= settings.near) & _select(scene, settings)
    indices = np.flatnonzero(near)
    if not len(indices):
        return None
    alphas = _evaluate_alphas(scene, indices, offsets[indices], distances[indices], direction)
    seen = alphas >= ALPHA_CUT
    indices, alphas = indices[seen], alphas[seen]
    if not len(indices):
        return None
    order = np.argsort(distances[indices], kind="stable")
    indices, alphas = indices[order], alphas[order]
    weights = alphas * np.concatenate((np.ones(1), np.cumprod(1 - alphas)[:-1]))
    depth = float((weights * distances[indices]).sum() / weights.sum())
    x, y, z = (origin + depth * direction).tolist()
    return PickedPoint((x, y, z), depth)


def _select(scene: Scene, settings: DrawSettings) -> Bool[np.ndarray, "n"]:
    gaussians = scene.gaussians
    selected = np.ones(len(gaussians), bool)
    if settings.levels is not None:
        selected &= np.isin(gaussians.levels.numpy(), list(settings.levels))
    if settings.mode == "view":
        selected &= gaussians.views.numpy() == settings.view
    return selected


def _evaluate_alphas(
    scene: Scene,
    indices: np.ndarray,
    offsets: Float[np.ndarray, "n 3"],
    distances: Float[np.ndarray, "n"],
    direction: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n"]:
    """Return the largest response of each Gaussian on the ray; 0 if it lies behind the origin."""
    gaussians = scene.gaussians
    chosen = torch.from_numpy(indices)
    rotations = rotations_from_quats(gaussians.quats[chosen].double()).numpy()
    scales = np.maximum(gaussians.scales[chosen].double().numpy(), _MIN_RELATIVE_SCALE * distances[:, None])
    mean = np.einsum("nji,nj->ni", rotations, offsets) / scales  # in the axes in which the Gaussian is a unit ball
    ray = np.einsum("nji,j->ni", rotations, direction) / scales
    squared = (np.cross(mean, ray) ** 2).sum(axis=1) / (ray**2).sum(axis=1)
    ahead = (mean * ray).sum(axis=1) > 0
    alphas = gaussians.opacities[chosen].double().numpy() * np.exp(-0.5 * squared)
    return np.where(ahead, np.minimum(alphas, MAX_ALPHA), 0)
