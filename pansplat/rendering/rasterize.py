"""The function `rasterize`: options, arguments, the type of backends, background and normalisation.

Source: docs/rendering.md; PanSplat, section 3.4; docs/adr/0005 for why there are several backends.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, ParamSpec, TypeVar, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.constants import FILTER_VARIANCE, NEAR
from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import orthonormal_error
from pansplat.rendering.image_planes import ImagePlane, Layout, image_planes, stitch_faces
from pansplat.system.descriptions import describe_count, describe_range
from pansplat.system.devices import find_triton_problem

Kernel = Literal["ray", "ewa"]
Backend = Literal["auto", "torch", "numba", "triton"]

MAX_EYE_OFFSET = 1e6  # metres
_MAX_POSE_ERROR = 1e-4  # largest `orthonormal_error` of a camera's rotation

_P = ParamSpec("_P")
_R = TypeVar("_R")


@dataclass(frozen=True)
class RasterOptions:
    """Options of an image, apart from scene, camera and layout.

    Attributes:
        kernel: "ray" is exact; "ewa" is the approximation of 3DGS, for pinhole images and cube faces, with the low-pass
            filter, the order by depth, and the stitching of cube faces of the official code.
        near: Gaussians whose mean is nearer are not rasterised, metres.
    """

    kernel: Kernel = "ray"
    near: float = NEAR

    def __post_init__(self) -> None:
        _check_choice("kernel", self.kernel, Kernel)
        if not 0 < self.near < math.inf:
            raise InputError(f"`near` must be a positive distance in metres, got {self.near}")

    def filter_variance(self, pixel_angle: float) -> float:
        """e^2 of docs/rendering.md: the variance added across the ray, radians^2."""
        return FILTER_VARIANCE * pixel_angle**2 if self.kernel == "ray" else 0.0


RasterBackend = Callable[
    [Gaussians, Float[Tensor, "4 4"], list[ImagePlane], RasterOptions], Float[Tensor, "plane sums height width"]
]
"""A backend's `rasterize_planes`: sums along each pixel's ray of weight x (channels, radial distance, 1).

It is differentiable in the pose (cam2world, float64, rigid) and in all floating-point fields of the Gaussians (float32
or float64). The image planes have one size and focal length; a panorama with an eye offset is the only one.
"""


@dataclass(frozen=True, eq=False)
class Rendering:
    """One image.

    Attributes:
        color: the Gaussians' channels (RGB) over the background; not clamped to 1.
        alpha: opacity in [0, 1].
        depth: mean radial distance, weighted as the colours are, metres; 0 where alpha is 0.
        background: behind the Gaussians; None for black.
    """

    color: Float[Tensor, "channel height width"]
    alpha: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    background: Float[Tensor, "channel"] | None = None

    def __repr__(self) -> str:
        channels, height, width = self.color.shape
        parts = [f"{height}x{width}", "RGB" if channels == 3 else describe_count(channels, "channel")]
        alpha, depth = self.alpha.detach(), self.depth.detach()
        if alpha.numel():
            parts.append(f"alpha {describe_range(float(alpha.min()), float(alpha.max()))}")
        depths = depth[alpha > 0]
        if len(depths):
            parts.append(f"depth {describe_range(float(depths.min()), float(depths.max()), 'm')}")
        return f"<Rendering: {', '.join(parts)}>"


def _exclude_from_compile(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Exclude a function from torch.compile, which cannot trace kernels that are not torch operations."""

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if torch.compiler.is_compiling():  # its `disable` imports the compiler, which takes a second
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return call


@_exclude_from_compile
def rasterize(
    gaussians: Gaussians,
    cam2world: Float[Tensor, "4 4"],
    *,
    size: tuple[int, int],
    layout: Layout = "equirect",
    vertical_fov_degrees: float = 90.0,
    face_size: int | None = None,
    eye_offset: float = 0.0,
    background: Sequence[float] | Float[Tensor, "channel"] = (0.0, 0.0, 0.0),
    backend: Backend = "auto",
    kernel: Kernel = "ray",
    near: float = NEAR,
) -> Rendering:
    """Rasterise Gaussians as one camera sees them.

    Source: docs/rendering.md; PanSplat, section 3.4.

    Args:
        gaussians: float32 or float64 (float16 and bfloat16 become float32); differentiable in all but the labels.
        cam2world: rigid pose, metres; differentiable.
        size: height and width of the image, pixels.
        layout: "equirect" has one ray for each pixel; "cubemap" stitches a panorama from six faces; "pinhole".
        vertical_fov_degrees: vertical field of view of a pinhole image.
        face_size: side of a cubemap's faces, pixels; by default with the panorama's resolution at the equator.
        eye_offset: in layout "equirect", radius of the viewing circle of omni-directional stereo, metres, half the
            distance of the eyes. Positive for the right eye, negative for the left. The gradients are those of "torch".
        background: one number for each channel; the default is black for any number of channels.
        backend: "torch" is the reference, "numba" fast on a CPU (kernel "ray", three channels), "triton" on CUDA;
            "auto" chooses the fastest available for the kernel, and the Gaussians' type, channels and device.
        kernel, near: see `RasterOptions`.

    Returns:
        The image, in the Gaussians' type.
    """
    options = RasterOptions(kernel, near)
    _check_arguments(size, layout, vertical_fov_degrees, face_size, eye_offset, backend, options)
    device = gaussians.means.device
    pose = torch.as_tensor(cam2world, device=device).double()
    error = orthonormal_error(pose.detach()) if pose.shape == (4, 4) else math.inf
    if error > _MAX_POSE_ERROR:
        raise InputError(
            f"`cam2world` must be a rigid 4x4 camera-to-world matrix, got shape {tuple(pose.shape)} with an "
            f"error of {error:.2g}; normalise its rotation, and check that it is not a projection or a mirror image"
        )
    if gaussians.means.dtype not in (torch.float32, torch.float64):
        gaussians = gaussians.to(dtype=torch.float32)
    background_color = _convert_background(background, gaussians)
    planes = image_planes(
        layout,
        size,
        vertical_fov_degrees=vertical_fov_degrees,
        face_size=face_size,
        eye_offset=eye_offset,
        device=device,
    )
    sums = _select_backend(backend, gaussians, options.kernel)(gaussians, pose, planes, options)
    sums = stitch_faces(sums, size, official=kernel == "ewa") if layout == "cubemap" else sums.squeeze(0)
    return normalise_sums(sums, background_color)


def _select_backend(name: Backend, gaussians: Gaussians, kernel: Kernel) -> RasterBackend:
    """Select the backend of this name; "auto" chooses by the kernel, and the Gaussians' type, channels and device."""
    if name == "auto":
        on_cpu = gaussians.means.device.type == "cpu"
        has_numba = on_cpu and kernel == "ray" and gaussians.harmonics.shape[2] == 3
        available = has_numba if on_cpu else gaussians.means.is_cuda and find_triton_problem() is None
        fast: Backend = "numba" if on_cpu else "triton"
        name = fast if available and gaussians.means.dtype == torch.float32 else "torch"
    if name == "numba":
        from pansplat.rendering.cpu import rasterize_planes
    elif name == "triton":
        from pansplat.rendering.cuda import rasterize_planes
    else:
        from pansplat.rendering.reference import rasterize_planes
    return rasterize_planes


def _check_choice(name: str, value: str, choices: object) -> None:
    if value not in get_args(choices):
        raise InputError(f"`{name}` must be one of {', '.join(get_args(choices))}, got {value!r}")


def _check_arguments(
    size: tuple[int, int],
    layout: str,
    vertical_fov_degrees: float,
    face_size: int | None,
    eye_offset: float,
    backend: str,
    options: RasterOptions,
) -> None:
    _check_choice("layout", layout, Layout)
    _check_choice("backend", backend, Backend)
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"`size` must be (height, width), both at least 1 pixel, got {size}")
    if face_size is not None and face_size < 1:
        raise InputError(f"`face_size` must be at least 1 pixel, got {face_size}")
    if not 0 < vertical_fov_degrees < 180:
        raise InputError(f"`vertical_fov_degrees` must lie between 0 and 180, got {vertical_fov_degrees}")
    if not -MAX_EYE_OFFSET <= eye_offset <= MAX_EYE_OFFSET:
        raise InputError(f"`eye_offset` must be from -{MAX_EYE_OFFSET} to {MAX_EYE_OFFSET} metres, got {eye_offset}")
    if eye_offset and layout != "equirect":
        raise InputError(
            f"`eye_offset` is the viewing circle of layout 'equirect', got layout {layout!r}; move the pose instead"
        )
    if options.kernel == "ewa" and layout == "equirect":
        raise InputError(
            "kernel 'ewa' approximates a pinhole projection and is not defined on layout 'equirect'; "
            "use layout='cubemap', or kernel='ray'"
        )
    if options.kernel == "ewa" and layout == "cubemap" and (size[0] % 4 or size[1] != 2 * size[0]):
        raise InputError(
            "kernel 'ewa' on layout 'cubemap' needs a 2:1 panorama with a height that is a multiple of 4, got size "
            f"{tuple(size)}; choose another size, or use kernel='ray'"
        )


def _convert_background(given: Sequence[float] | Tensor, gaussians: Gaussians) -> Float[Tensor, "channel"] | None:
    """Convert the background to the Gaussians' type and number of channels; None for constant black."""
    if not isinstance(given, Tensor) and not any(given):
        return None
    color = torch.as_tensor(given, dtype=gaussians.means.dtype, device=gaussians.means.device)
    channels = gaussians.harmonics.shape[2]
    if color.shape != (channels,) and not color.any():
        color = color.new_zeros(channels)
    if color.shape != (channels,):
        raise InputError(
            f"`background` must hold {channels} numbers, one for each channel of the Gaussians, got "
            f"{tuple(color.shape)}"
        )
    return color


def normalise_sums(sums: Float[Tensor, "sums height width"], background: Float[Tensor, "channel"] | None) -> Rendering:
    """Composite over the background, and divide the sum of distances by the sum of weights."""
    # The backward of `split` concatenates three pieces; that of indexing would add three whole images.
    channels, distance, weight = sums.split((len(sums) - 2, 1, 1))
    distance, weight = distance.squeeze(0), weight.squeeze(0)
    alpha = weight.clamp_max(1)
    color = channels.clone() if background is None else channels + (1 - alpha) * background[:, None, None]
    seen = weight > 0
    depth = torch.where(seen, distance / torch.where(seen, weight, torch.ones_like(weight)), 0)
    return Rendering(color, alpha, depth, background)
