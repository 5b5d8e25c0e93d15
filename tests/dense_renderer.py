"""Backends with their tolerances, scenes of Gaussians, and a dense renderer: docs/rendering.md word for word."""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from pansplat.gaussians.harmonics import SH_0, evaluate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.cubemap import face_poses
from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.pose import rotations_from_quats
from pansplat.rendering import Rendering, rasterize
from pansplat.rendering.image_planes import stitch_faces

FIELDS = ("means", "scales", "quats", "opacities", "harmonics")
NO_QUATS = ("means", "scales", "opacities", "harmonics", "pose", "background")
ORIGIN = torch.eye(4, dtype=torch.float64)
POSE = ORIGIN.clone()
"""A camera rotated about all axes, not at the origin."""
POSE[:3, :3] = rotations_from_quats(torch.tensor((0.9, 0.2, -0.3, 0.4), dtype=torch.float64))
POSE[:3, 3] = torch.tensor((0.1, 0.2, -0.1))


@dataclasses.dataclass(frozen=True)
class Renderer:
    """A backend, its type and its tolerances.

    Attributes:
        image: largest error of a pixel that is not within rounding of a cut.
        gradient: relative error of a field's gradient, by norm.
        height: of the tests' panoramas, pixels.
    """

    name: str
    dtype: torch.dtype
    image: float
    gradient: float
    height: int = 16

    @property
    def interpreted(self) -> bool:
        """Whether it runs under Triton's interpreter, a thousand times slower."""
        return self.name == "triton" and not torch.cuda.is_available()

    @property
    def size(self) -> tuple[int, int]:
        return self.height, 2 * self.height

    def __call__(self, scene: Gaussians, pose: Tensor | None = None, **options) -> Rendering:
        pose = ORIGIN if pose is None else pose
        options = {"size": self.size, **options}
        device = "cuda" if self.name == "triton" and torch.cuda.is_available() else "cpu"
        got = rasterize(scene.to(dtype=self.dtype, device=device), pose, backend=self.name, **options)
        return dataclasses.replace(got, color=got.color.cpu(), alpha=got.alpha.cpu(), depth=got.depth.cpu())


BACKENDS = {
    "float64": Renderer("torch", torch.float64, 1e-9, 1e-8),
    "numba": Renderer("auto", torch.float32, 2e-6, 1e-5),  # for EWA images, which numba does not draw, torch
    "torch-float32": Renderer("torch", torch.float32, 2e-6, 1e-5),
    "triton": Renderer("triton", torch.float32, 1e-5, 2e-4, height=8),
}


def make_scene(count: int, *, seed: int = 0, scale: float = 0.15, extent: float = 1.5, degree: int = 2) -> Gaussians:
    """Random Gaussians around the origin, float64."""
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


def make_spheres(means, sigma=0.1, opacity=0.8, colours=(0.9, 0.4, 0.2)) -> Gaussians:
    """Spheres at given positions, each with a colour; float64."""
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
        harmonics=((colours - 0.5) / SH_0).expand(count, colours.shape[-1])[:, None].clone(),
        levels=label,
        views=label,
    )


def _adjugate(matrix: Tensor) -> Tensor:
    """Adjugate of symmetric 3x3 matrices by cross products of rows."""
    a, b, c = matrix.unbind(-2)
    return torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), dim=-1)


def _quadratic(vector: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("...i,...ij,...j->...", vector, matrix, vector)


def draw_dense(
    gaussians: Gaussians,
    cam2world: Tensor,
    size: tuple[int, int],
    *,
    layout: str = "equirect",
    fov: float = 90.0,
    face_size: int | None = None,
    kernel: str = "ray",
    near: float = 0.05,
) -> Tensor:
    """Colour on black, alpha, alpha x depth and, last, 1 within rounding of a cut, by a loop over the Gaussians."""
    if layout == "cubemap":
        num = face_size or max(1, round(2 * size[0] / math.pi))
        options = {"layout": "pinhole", "kernel": kernel, "near": near}
        faces = [draw_dense(gaussians, pose, (num, num), **options) for pose in face_poses(cam2world)]
        return stitch_faces(torch.stack(faces), size, official=kernel == "ewa")
    height, width = size
    is_panorama = layout == "equirect"
    rotation, centre = cam2world[:3, :3], cam2world[:3, 3]
    gaussians = gaussians.select((gaussians.means - centre).detach().norm(dim=1) >= near)
    focal = 0.5 * height / math.tan(math.radians(fov) / 2)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((x, y), dim=-1).double().reshape(-1, 2)
    if is_panorama:
        rays = pixel_directions(height, width, dtype=torch.float64).reshape(-1, 3)
    else:
        middle = torch.tensor((width / 2, height / 2), dtype=torch.float64)
        rays = torch.cat(((pixels - middle) / focal, torch.ones(len(pixels), 1, dtype=torch.float64)), dim=1)
    mean = (gaussians.means - centre) @ rotation
    radius = mean.norm(dim=1)
    s = rotation.T @ gaussians.covariances @ rotation
    angle = math.pi / height if is_panorama else 1 / focal
    opacity = gaussians.opacities
    if kernel == "ray":
        unfiltered, outer = s, mean[:, :, None] * mean[:, None, :]
        s = s + 0.1 * angle**2 * (radius.square()[:, None, None] * torch.eye(3, dtype=torch.float64) - outer)
        ratio = _quadratic(mean, _adjugate(unfiltered)) / _quadratic(mean, _adjugate(s))
        opacity = opacity * torch.sqrt(ratio.clamp_min(1e-12))
    colour = evaluate_harmonics(gaussians.harmonics, (gaussians.means - centre) / radius[:, None])
    key = radius if kernel == "ray" else mean[:, 2]
    sums = torch.zeros(colour.shape[1] + 2, len(rays), dtype=torch.float64)
    transmittance, close = torch.ones(len(rays), dtype=torch.float64), torch.zeros(len(rays), dtype=torch.bool)
    for i in torch.argsort(key.detach(), stable=True).tolist():
        if kernel == "ewa" and mean[i, 2] <= 0.2 * near:
            continue
        if kernel == "ray":
            adjugate = _adjugate(s[i])
            across = torch.linalg.cross(rays, mean[i].expand_as(rays))
            q = _quadratic(across, s[i]) / _quadratic(rays, adjugate)
            front = rays @ adjugate @ mean[i] > 0
        else:
            q = _ewa_q(mean[i], s[i], pixels, focal, size)
            front = torch.ones_like(q, dtype=torch.bool)
        raw = torch.where(front, opacity[i] * torch.exp(-q / 2), 0)
        for cut in (1 / 255, 0.99):
            close |= (raw / cut - 1).abs() < 1e-4
        alpha = raw.clamp_max(0.99)
        alpha = torch.where(alpha >= 1 / 255, alpha, 0)
        weight = alpha * transmittance
        sums = sums + weight * torch.cat((colour[i], torch.ones_like(radius[:1]), radius[i : i + 1]))[:, None]
        transmittance = transmittance * (1 - alpha)
    return torch.cat((sums, close.double()[None])).reshape(-1, height, width)


def _ewa_q(mean: Tensor, s: Tensor, pixels: Tensor, focal: float, size: tuple[int, int]) -> Tensor:
    height, width = size
    x, y, z = mean
    zero = torch.zeros_like(z)
    t_x = (x / z).clamp(-1.3 * width / 2 / focal, 1.3 * width / 2 / focal) * z
    t_y = (y / z).clamp(-1.3 * height / 2 / focal, 1.3 * height / 2 / focal) * z
    jacobian = torch.stack((focal / z, zero, -focal * t_x / z**2, zero, focal / z, -focal * t_y / z**2))
    jacobian = jacobian.reshape(2, 3)
    v = jacobian @ s @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64)
    centre = torch.stack((focal * x / z + width / 2, focal * y / z + height / 2))
    return _quadratic(pixels - centre, torch.linalg.inv(v))


def make_leaves(scene: Gaussians) -> Gaussians:
    """A copy whose fields require gradients."""
    fields = {name: getattr(scene, name).detach().clone().requires_grad_() for name in FIELDS}
    return dataclasses.replace(scene, **fields)


def measure_loss(image: Rendering, shown: Tensor | float = 1.0) -> Tensor:
    """A random weighted sum of every pixel's colour, alpha, and alpha x depth."""
    parts = torch.cat((image.color, image.alpha[None], (image.depth * image.alpha)[None])).double()
    weights = torch.rand(parts.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (parts * weights * shown).sum()


def find_gradients(render: Renderer, scene: Gaussians, pose: Tensor | None = None, **options) -> dict[str, Tensor]:
    """Gradients of the loss with respect to every field of the scene and the pose."""
    camera = (ORIGIN if pose is None else pose).clone().requires_grad_()
    fields = make_leaves(scene.to(dtype=render.dtype))
    measure_loss(render(fields, camera, **options)).backward()
    return {**{name: getattr(fields, name).grad for name in FIELDS}, "pose": camera.grad}


def assert_dense(
    render: Renderer, scene: Gaussians, options: dict[str, Any], truths: dict | None = None
) -> tuple[list, list]:
    """Assert that a backend's image, counts and gradients equal those of the dense renderer; returns both.

    Args:
        options: of `rasterize`; and `pose`; `slack`, by which the case is worse conditioned; `fields`, whose gradients
            are compared; and `metre`, the unit of length.
        truths: results of the dense renderer for this scene and these options, by type and size; a new one is added.
    """
    options = {"size": render.size, **options}
    chosen = {name: options.pop(name, None) for name in ("pose", "slack", "fields", "metre")}
    pose = ORIGIN if chosen["pose"] is None else chosen["pose"]
    slack, metre = chosen["slack"] or 1.0, chosen["metre"] or 1.0
    background = torch.linspace(0.2, 0.9, scene.harmonics.shape[2], dtype=torch.float64)
    # The scene is rounded to the backend's type first, for the dense renderer too.
    rounded = scene.to(dtype=render.dtype)
    names = ("kernel", "near", "layout", "face_size")
    dense_options = {name: options[name] for name in names if name in options}

    def draw_truth(truth: Gaussians, camera: Tensor, ground: Tensor) -> tuple[Rendering, Tensor]:
        fov = options.get("vertical_fov_degrees", 90.0)
        sums = draw_dense(truth, camera, options["size"], fov=fov, **dense_options)
        color, (alpha, weighted, close) = sums[:-3], sums[-3:]
        depth = torch.where(alpha > 0, weighted / torch.where(alpha > 0, alpha, 1), 0)
        color = color + (1 - alpha) * ground[:, None, None]
        return Rendering(color, alpha, depth), (close == 0).detach()

    def draw(given: Gaussians, camera: Tensor, ground: Tensor) -> tuple[Rendering, Tensor]:
        return render(given, camera, background=ground, **options), shown

    def differentiate(function: Any, given: Gaussians) -> tuple[Rendering, dict[str, Tensor], Tensor]:
        inputs, camera, ground = make_leaves(given), pose.clone().requires_grad_(), background.clone().requires_grad_()
        image, mask = function(inputs, camera, ground)
        measure_loss(image, mask).backward()
        leaves = {name: getattr(inputs, name) for name in FIELDS} | {"pose": camera, "background": ground}
        found = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
        turn = pose[:3, :3].T @ found["pose"][:3, :3]  # both formulas agree along rigid motions only
        found["pose"] = torch.cat((turn - turn.T, metre * found["pose"][:3, 3:]), dim=1)
        return Rendering(image.color.detach(), image.alpha.detach(), image.depth.detach()), found, mask

    truths, key = {} if truths is None else truths, (render.dtype, options["size"])
    if key not in truths:
        truths[key] = differentiate(draw_truth, rounded.to(dtype=torch.float64))
    truth, expected_gradients, shown = truths[key]
    got, gradients, _ = differentiate(draw, rounded)
    assert shown.double().mean() > 0.8, "most pixels are not at a cut"
    for name, weight in (("color", 1.0), ("alpha", 1.0), ("depth", truth.alpha / metre)):
        error = (getattr(got, name) - getattr(truth, name)) * weight * shown
        size = max(1.0, float((getattr(truth, name) * weight).abs().max()))
        assert float(error.abs().max()) <= slack * render.image * size, f"{name} off by {float(error.abs().max()):.2g}"
    for name in chosen["fields"] or (*NO_QUATS, "quats"):
        expected, found = expected_gradients[name].double(), gradients[name].double()
        assert torch.isfinite(found).all(), name
        unit = metre if name in ("means", "scales") else 1.0
        norm = max(unit * float(expected.norm()), 1e-6)  # a sphere's quaternion has only rounding errors as gradient
        error = unit * float((found - expected).norm()) / norm
        assert error <= slack * render.gradient, f"gradient of {name} off by {error:.2g}"
    return [truth, got], [expected_gradients, gradients]
