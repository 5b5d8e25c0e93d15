"""Renders the cases of the raster benchmark with the backends of `pansplat.rasterize`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.raster_cases import RasterCase
from pansplat.constants import NEAR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


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
        for case in trials:
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
