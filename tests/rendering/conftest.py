"""Scenes, camera poses, and a dense renderer that is a literal translation of docs/rendering.md."""

import math
import os
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats


def _scene(count: int, *, seed: int = 0, scale: float = 0.15, extent: float = 1.5, degree: int = 2) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        means=extent * normal(count, 3),
        scales=scale * torch.exp(0.7 * normal(count, 3)),
        quats=normal(count, 4),
        opacities=torch.sigmoid(normal(count) + 1),
        harmonics=0.4 * normal(count, (degree + 1) ** 2, 3),
        levels=torch.zeros(count, dtype=torch.int64),
        views=torch.zeros(count, dtype=torch.int64),
    )


def _balls(means, sigma=0.1, opacity=0.8, colours=(0.9, 0.4, 0.2)) -> Gaussians:
    means = torch.as_tensor(means, dtype=torch.float64).reshape(-1, 3)
    count = len(means)
    ones = torch.ones(count, dtype=torch.float64)
    colours = torch.as_tensor(colours, dtype=torch.float64)
    label = torch.zeros(count, dtype=torch.int64)
    return Gaussians(
        means=means,
        scales=(ones * torch.as_tensor(sigma, dtype=torch.float64))[:, None].expand(count, 3).clone(),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(count, 1),
        opacities=ones * torch.as_tensor(opacity, dtype=torch.float64),
        harmonics=((colours - 0.5) / 0.28209479177387814).expand(count, colours.shape[-1])[:, None].clone(),
        levels=label,
        views=label,
    )


@pytest.fixture
def balls() -> Callable[..., Gaussians]:
    """Spheres at given positions, each with a colour; float64."""
    return _balls


def _adjugate(matrix: Tensor) -> Tensor:
    """Adjugate of symmetric 3x3 matrices by cross products of rows."""
    a, b, c = matrix.unbind(-2)
    return torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), dim=-1)


def _quadratic(vector: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("...i,...ij,...j->...", vector, matrix, vector)


def _dense(
    gaussians: Gaussians,
    cam2world: Tensor,
    size: tuple[int, int],
    *,
    fov: float | None = None,
    kernel: str = "ray",
    order: str = "radial",
    lowpass: str = "angular",
    near: float = 0.05,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour on black, alpha and alpha x depth, by a loop over the Gaussians."""
    height, width = size
    rotation, centre = cam2world[:3, :3], cam2world[:3, 3]
    focal = 0.0 if fov is None else 0.5 * height / math.tan(math.radians(fov) / 2)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((x, y), dim=-1).double().reshape(-1, 2)
    if fov is None:
        rays = pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)
    else:
        middle = torch.tensor((width / 2, height / 2), dtype=torch.float64)
        rays = torch.cat(((pixels - middle) / focal, torch.ones(len(pixels), 1, dtype=torch.float64)), dim=1)
    mean = (gaussians.means - centre) @ rotation
    radius = mean.norm(dim=1)
    s = rotation.T @ gaussians.covariances @ rotation
    angle = math.pi / height if fov is None else 1 / focal
    unfiltered = s
    if lowpass == "angular" or kernel == "ray":
        e2 = {"angular": 0.1, "3dgs": 0.3}[lowpass] * angle**2
        outer = mean[:, :, None] * mean[:, None, :]
        s = s + e2 * (radius.square()[:, None, None] * torch.eye(3, dtype=torch.float64) - outer)
    opacity = gaussians.opacities
    if lowpass == "angular":
        ratio = _quadratic(mean, _adjugate(unfiltered)) / _quadratic(mean, _adjugate(s))
        opacity = opacity * torch.sqrt(ratio.clamp_min(1e-12))
    colour = evaluate_harmonics(gaussians.harmonics, (gaussians.means - centre) / radius[:, None])
    key = radius if order == "radial" else mean[:, 2]
    sums, transmittance = torch.zeros(5, len(rays), dtype=torch.float64), torch.ones(len(rays), dtype=torch.float64)
    for i in torch.argsort(key.detach(), stable=True).tolist():
        if radius[i] < near or (kernel == "ewa" and mean[i, 2] <= 0.2 * near):
            continue
        if kernel == "ray":
            adjugate = _adjugate(s[i])
            across = torch.linalg.cross(rays, mean[i].expand_as(rays))
            q = _quadratic(across, s[i]) / _quadratic(rays, adjugate)
            front = rays @ adjugate @ mean[i] > 0
        else:
            dilation = 0.3 if lowpass == "3dgs" else 0.0
            q = _ewa_q(mean[i], s[i], pixels, focal, size, dilation)
            front = torch.ones_like(q, dtype=torch.bool)
        alpha = (opacity[i] * torch.exp(-q / 2)).clamp_max(0.99)
        alpha = torch.where(front & (alpha >= 1 / 255), alpha, 0)
        weight = alpha * transmittance
        sums = sums + weight * torch.cat((colour[i], radius[i : i + 1], torch.ones_like(radius[:1])))[:, None]
        transmittance = transmittance * (1 - alpha)
    sums = sums.reshape(5, height, width)
    return sums[:3], sums[4], sums[3]


def _ewa_q(mean: Tensor, s: Tensor, pixels: Tensor, focal: float, size: tuple[int, int], dilation: float) -> Tensor:
    height, width = size
    x, y, z = mean
    zero = torch.zeros_like(z)
    t_x = (x / z).clamp(-1.3 * width / 2 / focal, 1.3 * width / 2 / focal) * z
    t_y = (y / z).clamp(-1.3 * height / 2 / focal, 1.3 * height / 2 / focal) * z
    jacobian = torch.stack((focal / z, zero, -focal * t_x / z**2, zero, focal / z, -focal * t_y / z**2))
    jacobian = jacobian.reshape(2, 3)
    v = jacobian @ s @ jacobian.T + dilation * torch.eye(2, dtype=torch.float64)
    centre = torch.stack((focal * x / z + width / 2, focal * y / z + height / 2))
    return _quadratic(pixels - centre, torch.linalg.inv(v))


@pytest.fixture
def make_scene() -> Callable[..., Gaussians]:
    """Random Gaussians around the origin, float64."""
    return _scene


@pytest.fixture
def dense() -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
    """The dense renderer."""
    return _dense


@pytest.fixture
def pose() -> Tensor:
    """A camera rotated about all axes, not at the origin."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotations_from_quats(torch.tensor((0.9, 0.2, -0.3, 0.4), dtype=torch.float64))
    pose[:3, 3] = torch.tensor((0.1, 0.2, -0.1))
    return pose


@pytest.fixture
def yaw() -> Callable[[float], Tensor]:
    """A camera at the origin, rotated about y by an angle in radians."""

    def make(angle: float) -> Tensor:
        pose, c, s = torch.eye(4, dtype=torch.float64), math.cos(angle), math.sin(angle)
        pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
        return pose

    return make


@pytest.fixture(scope="session")
def triton_device() -> str:
    """The device of Triton's kernels: "cuda", or without one "cpu" under Triton's interpreter."""
    if torch.cuda.is_available():
        return "cuda"
    os.environ["TRITON_INTERPRET"] = "1"
    import triton.language as tl
    from triton.runtime import interpreter

    assert isinstance(tl.sum, interpreter.InterpretedFunction), (
        "triton was imported before TRITON_INTERPRET=1 was set; set it at the head of the conftest.py"
    )
    # It patches its language at every call of a device function; once is enough, and six times faster.
    interpreter._patch_lang(tl.sum.fn)
    interpreter.InterpretedFunction.__call__ = lambda self, *args, **kwargs: self.rewrite()(*args, **kwargs)
    return "cpu"
