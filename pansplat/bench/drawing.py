"""Draws a case: by the backends of `pansplat.rasterize`, or by a peer."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.bench.cases import Case
from pansplat.bench.dense import render_dense
from pansplat.bench.gsplat_peer import render_gsplat
from pansplat.constants import NEAR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")
_ON_CUDA = ("triton", "gsplat")


@dataclass(frozen=True, eq=False)
class Picture:
    """Colours on black, and what the renderer tells about drawing them.

    Attributes:
        stages: seconds by stage, where it tells.
    """

    color: Float[Tensor, "channel height width"]
    stages: dict[str, float] = field(default_factory=dict)


def device_of(backend: str) -> torch.device:
    """Where a backend draws."""
    return torch.device("cuda" if backend in _ON_CUDA else "cpu")


def draw(case: Case, gaussians: Gaussians, pose: Float[Tensor, "4 4"]) -> Picture:
    """Draw one picture; differentiable in the Gaussians.

    Args:
        gaussians: of the case's precision, on its backend's device.
        pose: cam2world.

    Raises:
        InputError: the backend or the peer cannot draw here, or not this.
    """
    if case.backend == "dense":
        return Picture(render_dense(gaussians, pose, case.height, near=NEAR))
    if case.backend == "gsplat":
        return Picture(render_gsplat(case, gaussians, pose, near=NEAR))
    drawn = rasterize(
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
    return Picture(drawn.color, {} if drawn.info is None else drawn.info.seconds)


def draw_and_differentiate(
    case: Case, gaussians: Gaussians, pose: Float[Tensor, "4 4"]
) -> tuple[Picture, list[Tensor], Float[Tensor, "channel height width"]]:
    """A picture with its graph, the fields it depends on, and a slope of each of its colours to start from."""
    leaves = {name: getattr(gaussians, name).detach().requires_grad_() for name in _FIELDS}
    picture = draw(case, replace(gaussians, **leaves), pose)
    generator = torch.Generator().manual_seed(0)
    upstream = torch.rand(picture.color.shape, generator=generator).to(picture.color)
    return picture, list(leaves.values()), upstream


def why_not(backend: str) -> str | None:
    """Why a backend cannot draw here; None when it can. Drawing the trial compiles what has to be compiled."""
    if backend in _ON_CUDA and not torch.cuda.is_available():
        return "there is no CUDA device"
    trials = [
        Case(backend, 8),
        Case(backend, 8, layout="cubemap", face_size=4),
        Case(backend, 8, "ewa", "z", layout="cubemap", face_size=4),
    ]
    try:
        gaussians = _speck().to(device=device_of(backend))
        for case in (trial for trial in trials if trial.possible):
            picture, leaves, upstream = draw_and_differentiate(case, gaussians, torch.eye(4, dtype=torch.float64))
            torch.autograd.grad(picture.color, leaves, upstream)
    except (ImportError, AttributeError, InputError) as error:
        return str(error) or type(error).__name__
    return None


def wake(case: Case) -> None:
    """Bring back what a renderer keeps by the picture's size alone, as between two pictures of a film."""
    with torch.no_grad():
        gaussians = _speck().to(dtype=getattr(torch, case.precision), device=device_of(case.backend))
        draw(case, gaussians, torch.eye(4, dtype=torch.float64))


def forget(backend: str) -> None:
    """Let go of memory that a backend keeps for its next picture, so that what one takes can be measured."""
    if backend == "numba":
        from pansplat.rendering.cpu.runtime import release_idle_memory

        release_idle_memory()


def _speck() -> Gaussians:
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
