"""Renders the cases of the raster benchmark: the backends of `pansplat.rasterize` and a dense renderer."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from pansplat.bench.raster_cases import RasterCase
from pansplat.constants import ALPHA_CUT, FILTER_VARIANCE, MAX_ALPHA, NEAR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions
from pansplat.rendering import rasterize
from pansplat.rendering.projection import project_gaussians

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")
_DENSE_BLOCK_SIZE = 16  # pixels; float32 resolves the differences of directions within a block


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """Colours on black, and seconds by stage if the renderer reports them."""

    color: Float[Tensor, "channel height width"]
    stages: dict[str, float] = field(default_factory=dict)


def device_of(backend: str) -> torch.device:
    """The device that a backend renders on."""
    return torch.device("cuda" if backend == "triton" else "cpu")


def render_case(case: RasterCase, gaussians: Gaussians, pose: Float[Tensor, "4 4"]) -> RenderedImage:
    """Render one image; differentiable in the Gaussians.

    Args:
        gaussians: of the case's precision, on its backend's device.
        pose: cam2world.

    Raises:
        InputError: the backend is not available or does not render such an image.
    """
    if case.backend == "dense":
        return RenderedImage(render_dense(gaussians, pose, case.height))
    rendered = rasterize(
        gaussians,
        pose,
        size=case.size,
        layout=case.layout,
        kernel=case.kernel,
        order=case.order,
        lowpass=case.filter,
        near=NEAR,
        face_size=case.face_size,
        stitching=case.stitching,
        backend=case.backend,  # type: ignore[arg-type]
    )
    return RenderedImage(rendered.color, {} if rendered.info is None else rendered.info.seconds)


def render_with_graph(
    case: RasterCase, gaussians: Gaussians, pose: Float[Tensor, "4 4"]
) -> tuple[RenderedImage, list[Tensor], Float[Tensor, "channel height width"]]:
    """An image with its autograd graph, the leaves that it depends on, and a random gradient of its colours."""
    leaves = {name: getattr(gaussians, name).detach().requires_grad_() for name in _FIELDS}
    image = render_case(case, replace(gaussians, **leaves), pose)
    generator = torch.Generator().manual_seed(0)
    grad_color = torch.rand(image.color.shape, generator=generator).to(image.color)
    return image, list(leaves.values()), grad_color


def unavailable_reason(backend: str) -> str | None:
    """Why a backend cannot render here; None if it can. Compiles its kernels."""
    if backend == "triton" and not torch.cuda.is_available():
        return "there is no CUDA device"
    trials = [
        RasterCase(backend, 8),
        RasterCase(backend, 8, layout="cubemap", face_size=4),
        RasterCase(backend, 8, "ewa", "z", layout="cubemap", face_size=4),
    ]
    try:
        gaussians = _single_gaussian().to(device=device_of(backend))
        for case in (trial for trial in trials if trial.is_supported):
            image, leaves, grad_color = render_with_graph(case, gaussians, torch.eye(4, dtype=torch.float64))
            torch.autograd.grad(image.color, leaves, grad_color)
    except (ImportError, AttributeError, InputError) as error:
        return str(error) or type(error).__name__
    return None


def warm_up(case: RasterCase) -> None:
    """Compute the tables that depend on the image size alone, as after the first frame of a video."""
    with torch.no_grad():
        gaussians = _single_gaussian().to(dtype=getattr(torch, case.precision), device=device_of(case.backend))
        render_case(case, gaussians, torch.eye(4, dtype=torch.float64))


def release_workspace(backend: str) -> None:
    """Free the buffers that a backend keeps for its next image, so that the memory of one image can be measured."""
    if backend == "numba":
        from pansplat.rendering.cpu.runtime import release_idle_memory

        release_idle_memory()


def _single_gaussian() -> Gaussians:
    """One Gaussian in front of the camera."""
    labels = torch.zeros(1, dtype=torch.int64)
    return Gaussians(
        means=torch.tensor([[0.1, 0.1, 2.0]]),
        scales=torch.full((1, 3), 0.3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacities=torch.tensor([0.5]),
        harmonics=torch.ones(1, 1, 3),
        levels=labels,
        views=labels,
    )


def render_dense(
    gaussians: Gaussians, cam2world: Float[Tensor, "4 4"], height: int, *, near: float = NEAR
) -> Float[Tensor, "channel height width"]:
    """A panorama on black from every pair of a pixel and a Gaussian, without tiles or boxes; differentiable.

    Exact kernel, radial order, angular filter.

    Source: docs/rendering.md, sections 3 and 4.

    Args:
        gaussians: all finite.
        cam2world: rigid, metres.
        height: of the panorama, pixels.
        near: Gaussians whose mean is nearer are left out, metres.
    """
    pose = cam2world.double()
    radius = torch.linalg.vector_norm(gaussians.means.detach().double() - pose[:3, 3], dim=1)
    index = torch.argsort(radius, stable=True)
    gaussians = gaussians.select(index[radius[index] >= near])
    variance = FILTER_VARIANCE["angular"] * (math.pi / height) ** 2
    seen = project_gaussians(gaussians, None, pose, filter_variance=variance, compensate=True, exact=True)
    footprints = seen.rows, seen.radial_variance, seen.peak, seen.values[:, :-1]
    directions = pixel_directions(height, 2 * height, dtype=torch.float64)
    rows = []
    for strip in directions.split(_DENSE_BLOCK_SIZE):
        blocks = []
        for block in strip.split(_DENSE_BLOCK_SIZE, dim=1):
            arguments = (*footprints, seen.direction, block.reshape(-1, 3))
            if torch.is_grad_enabled():
                sums = checkpoint(_render_dense_block, *arguments, use_reentrant=False)
            else:
                sums = _render_dense_block(*arguments)
            blocks.append(sums.reshape(*block.shape[:2], -1))
        rows.append(torch.cat(blocks, dim=1))
    return torch.cat(rows).permute(2, 0, 1)


def _render_dense_block(
    footprint_rows: Float[Tensor, "n 3 3"],
    radial_variance: Float[Tensor, "n"],
    peak: Float[Tensor, "n"],
    values: Float[Tensor, "n channel"],
    direction: Float[Tensor, "n 3"],
    pixels: Float[Tensor, "pixel 3"],
) -> Float[Tensor, "pixel channel"]:
    """Colours of a block of pixels; the Gaussians are sorted front to back."""
    centre = pixels.mean(dim=0)
    offsets = (pixels - centre).to(footprint_rows.dtype)
    constant = -(footprint_rows @ (direction - centre).to(footprint_rows.dtype)[:, :, None])
    a, b, front = (footprint_rows @ offsets.T + constant).unbind(1)
    front = 1 + front
    square = a * a + b * b
    q = square / (front.clamp_min(1e-3).square() + radial_variance[:, None] * square)
    alpha = (peak[:, None] * torch.exp(-0.5 * q)).clamp_max(MAX_ALPHA)
    alpha = torch.where((front > 0) & (alpha >= ALPHA_CUT), alpha, 0)
    transmittance = torch.cumprod(1 - alpha, dim=0)
    weights = alpha * torch.cat((torch.ones_like(transmittance[:1]), transmittance[:-1]))
    return weights.T @ values
