"""The call that draws Gaussians: checks its arguments, chooses a backend, finishes the picture.

Source: docs/rendering.md; PanSplat, section 3.4.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Literal, ParamSpec, TypeVar, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.constants import NEAR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import orthonormal_error
from pansplat.rendering.backend import Draw, Info, Kernel, Lowpass, Options, Order
from pansplat.rendering.panorama import Layout, pictures
from pansplat.rendering.stitching import Stitching, stitch_faces

Backend = Literal["auto", "torch", "numba", "triton"]

_MODULES = {
    "torch": "pansplat.rendering.reference",
    "numba": "pansplat.rendering.cpu",
    "triton": "pansplat.rendering.cuda",
}
_RIGID = 1e-4

_Arguments, _Result = ParamSpec("_Arguments"), TypeVar("_Result")


def _untraced(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Have torch.compile call a function as it is: what is inside is not made of torch, and it would try every line."""

    @functools.wraps(function)
    def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if torch.compiler.is_compiling():  # only then: to disable it sooner would import the compiler, for a second
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return call


@dataclass(frozen=True, eq=False)
class Rendering:
    """One picture.

    Attributes:
        color: RGB (or as many channels as the Gaussians have) over the background; not limited at 1.
        alpha: opacity in [0, 1].
        depth: mean radial distance of what is seen, metres; 0 where alpha is 0.
        info: counts, where a rasteriser made it.
    """

    color: Float[Tensor, "channel height width"]
    alpha: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    info: Info | None = None


@_untraced
def rasterize(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    size: tuple[int, int],
    layout: Layout = "equirect",
    vertical_fov_degrees: float = 90.0,
    kernel: Kernel = "ray",
    order: Order = "radial",
    lowpass: Lowpass = "angular",
    covariances: Float[Tensor, "n 3 3"] | None = None,
    background: Sequence[float] | Float[Tensor, "channel"] = (0.0, 0.0, 0.0),
    near: float = NEAR,
    strict: bool = False,
    face_size: int | None = None,
    stitching: Stitching = "seamless",
    backend: Backend = "auto",
) -> Rendering:
    """Draw Gaussians as one camera sees them.

    Source: docs/rendering.md; PanSplat, section 3.4.

    Args:
        gaussians: float32 or float64 (halves are drawn in float32); differentiable in everything but labels.
        cam2world: rigid pose, metres; differentiable.
        size: height and width of the picture, pixels.
        layout: "equirect" traces one ray a pixel; "cubemap" stitches a panorama from six faces; "pinhole".
        vertical_fov_degrees: of the pinhole picture.
        kernel: "ray" is exact; "ewa" is the classic approximation, for pinhole pictures and cube faces.
        order: sort by distance, or by each picture's depth as the classic renderer does.
        lowpass: "angular" conserves energy; "3dgs" widens by 0.3 pixel^2.
        covariances: world covariances drawn in place of those of `scales` and `quats`, square metres.
        background: behind the scene, a number a channel; the default is black whatever the channels.
        near: Gaussians whose mean is nearer are left out, metres.
        strict: refuse Gaussians that are not finite rather than leave them out.
        face_size: of the cubemap's faces, pixels; by default as fine as the panorama's equator.
        stitching: of the cubemap's faces, "seamless", or "official" with the original's borders.
        backend: "torch" is the reference, "numba" is fast on a CPU, "triton" on CUDA; "auto" takes the fastest
            there is for the Gaussians' type and device.

    Returns:
        The picture, in the Gaussians' type.

    Raises:
        InputError: an argument is out of range or does not fit the Gaussians, the pose is not rigid, "ewa" is
            asked for on "equirect", or `strict` and a Gaussian is not finite.
    """
    _check(size, layout, vertical_fov_degrees, kernel, order, lowpass, near, face_size, stitching, backend)
    device = gaussians.means.device
    pose = torch.as_tensor(cam2world, device=device).double()
    error = orthonormal_error(pose.detach()) if pose.shape == (4, 4) else math.inf
    if error > _RIGID:
        raise InputError(
            f"`cam2world` must be a rigid 4x4 camera-to-world matrix, got shape {tuple(pose.shape)} with an "
            f"error of {error:.2g}; normalise its rotation, and check that it is no projection or mirror"
        )
    if gaussians.means.dtype not in (torch.float32, torch.float64):
        gaussians = gaussians.to(dtype=torch.float32)
    covariances = _covariances(covariances, gaussians)
    behind = _background(background, gaussians)
    planes = pictures(layout, size, vertical_fov_degrees=vertical_fov_degrees, face_size=face_size, device=device)
    options = Options(kernel, order, lowpass, near, strict)
    drawn = _backend(backend, gaussians)(gaussians, covariances, pose, planes, options)
    sums = stitch_faces(drawn.sums, size, stitching=stitching) if layout == "cubemap" else drawn.sums.squeeze(0)
    return _finish(sums, behind, drawn.info)


def _backend(name: Backend, gaussians: Gaussians) -> Draw:
    """The backend of that name; "auto" chooses by the Gaussians' type and device."""
    if name == "auto":
        fast: Backend = "numba" if gaussians.means.device.type == "cpu" else "triton"
        there = fast == "numba" or (gaussians.means.is_cuda and find_spec("triton") is not None)
        name = fast if there and gaussians.means.dtype == torch.float32 else "torch"
    module = import_module(_MODULES[name])
    return module.draw  # type: ignore[no-any-return]


def _check(
    size: tuple[int, int],
    layout: str,
    vertical_fov_degrees: float,
    kernel: str,
    order: str,
    lowpass: str,
    near: float,
    face_size: int | None,
    stitching: str,
    backend: str,
) -> None:
    choices = (
        ("layout", layout, Layout),
        ("kernel", kernel, Kernel),
        ("order", order, Order),
        ("lowpass", lowpass, Lowpass),
        ("stitching", stitching, Stitching),
        ("backend", backend, Backend),
    )
    for name, value, allowed in choices:
        if value not in get_args(allowed):
            raise InputError(f"`{name}` must be one of {', '.join(get_args(allowed))}, got {value!r}")
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"`size` must be (height, width), both at least 1 pixel, got {size}")
    if face_size is not None and face_size < 1:
        raise InputError(f"`face_size` must be at least 1 pixel, got {face_size}")
    if not 0 < vertical_fov_degrees < 180:
        raise InputError(f"`vertical_fov_degrees` must lie between 0 and 180, got {vertical_fov_degrees}")
    if not 0 < near < math.inf:
        raise InputError(f"`near` must be a positive distance in metres, got {near}")
    if kernel == "ewa" and layout == "equirect":
        raise InputError(
            "kernel 'ewa' approximates a pinhole projection and is not defined on layout 'equirect'; "
            "use layout='cubemap', or kernel='ray'"
        )
    if stitching == "official" and (layout != "cubemap" or size[0] % 4 or size[1] != 2 * size[0]):
        raise InputError(
            "stitching 'official' needs layout='cubemap' and a 2:1 panorama with a height that is a multiple of 4, "
            f"got layout={layout!r} and size {tuple(size)}; use stitching='seamless'"
        )


def _covariances(given: Tensor | None, gaussians: Gaussians) -> Tensor | None:
    """The covariances in the Gaussians' type, refused when they do not fit."""
    if given is None:
        return None
    if tuple(given.shape) != (len(gaussians), 3, 3):
        raise InputError(
            f"`covariances` must have shape ({len(gaussians)}, 3, 3), one matrix a Gaussian, got {tuple(given.shape)}"
        )
    return given.to(gaussians.means)


def _background(given: Sequence[float] | Tensor, gaussians: Gaussians) -> Float[Tensor, "channel"] | None:
    """The background in the Gaussians' type and number of channels; None if it is black and stays so."""
    if not isinstance(given, Tensor) and not any(given):
        return None
    behind = torch.as_tensor(given, dtype=gaussians.means.dtype, device=gaussians.means.device)
    channels = gaussians.harmonics.shape[2]
    if behind.shape != (channels,) and not behind.any():
        behind = behind.new_zeros(channels)
    if behind.shape != (channels,):
        raise InputError(
            f"`background` must hold {channels} numbers, as many as the Gaussians have channels, got "
            f"{tuple(behind.shape)}"
        )
    return behind


def _finish(
    sums: Float[Tensor, "sums height width"], background: Float[Tensor, "channel"] | None, info: Info
) -> Rendering:
    """Composite over the background, and turn the sum of distances into their mean."""
    # Split, not indexed: going back, three pieces are put together once instead of added as three whole pictures.
    channels, distance, weight = sums.split((len(sums) - 2, 1, 1))
    distance, weight = distance.squeeze(0), weight.squeeze(0)
    alpha = weight.clamp_max(1)
    color = channels.clone() if background is None else channels + (1 - alpha) * background[:, None, None]
    seen = weight > 0
    depth = torch.where(seen, distance / torch.where(seen, weight, torch.ones_like(weight)), 0)
    return Rendering(color, alpha, depth, info)
