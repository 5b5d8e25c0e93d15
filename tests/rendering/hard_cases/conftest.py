"""All backends, and their comparison with the dense float64 renderer, forward and backward.

A test runs with torch in float64, and in float32 with the backend of "auto" on a CPU: numba, and torch for the
EWA kernel. Tests marked `torch_float32` also run with torch in float32 and the exact kernel. Triton runs in
`pytest -m exhaustive`, on a GPU or under its interpreter, which is a thousand times slower.
"""

import dataclasses
import os
from collections.abc import Callable
from importlib.util import find_spec

import pytest
import torch
from torch import Tensor

from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import Rendering, rasterize

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # before the kernels are imported

_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


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

    def skip_interpreted(self, variation: bool) -> None:
        """Skip a variation under the interpreter; another parameter of the same test covers it."""
        if self.interpreted and variation:
            pytest.skip("not under Triton's interpreter: another variation covers it")

    def __call__(self, scene: Gaussians, pose: Tensor | None = None, **options) -> Rendering:
        pose = torch.eye(4, dtype=torch.float64) if pose is None else pose
        options = {"size": self.size, **options}
        device = "cuda" if self.name == "triton" and torch.cuda.is_available() else "cpu"
        got = rasterize(scene.to(dtype=self.dtype, device=device), pose, backend=self.name, **options)
        return dataclasses.replace(got, color=got.color.cpu(), alpha=got.alpha.cpu(), depth=got.depth.cpu())


_RENDERERS = {
    "float64": Renderer("torch", torch.float64, 1e-9, 1e-8),
    "float32": Renderer("auto", torch.float32, 5e-6, 1e-4),
    "torch-float32": Renderer("torch", torch.float32, 5e-6, 1e-4),
    "triton": Renderer("triton", torch.float32, 5e-6, 1e-4, height=8),
}
_TRITON = (
    pytest.mark.exhaustive,
    pytest.mark.skipif(find_spec("triton") is None and not os.environ.get("CI"), reason="triton needs Linux"),
)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "torch_float32: also with torch in float32 and the exact kernel")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "render" in metafunc.fixturenames:
        names = ["float64", "float32", pytest.param("triton", marks=_TRITON)]
        if metafunc.definition.get_closest_marker("torch_float32"):
            names.append("torch-float32")
        metafunc.parametrize("render", names, indirect=True)


@pytest.fixture
def render(request) -> Renderer:
    """A backend."""
    return _RENDERERS[request.param]


def _leaves(scene: Gaussians) -> Gaussians:
    fields = {name: getattr(scene, name).detach().clone().requires_grad_() for name in _FIELDS}
    return dataclasses.replace(scene, **fields)


@pytest.fixture
def leaves() -> Callable[[Gaussians], Gaussians]:
    """Copy Gaussians to leaves that require gradients."""
    return _leaves


def _loss(color: Tensor, alpha: Tensor, weighted_depth: Tensor) -> Tensor:
    """A random weighted sum of every pixel's colour, alpha, and alpha x depth."""
    parts = torch.cat((color.double(), alpha.double()[None], weighted_depth.double()[None]))
    weights = torch.rand(parts.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return (parts * weights).sum()


@pytest.fixture
def loss_of() -> Callable[[Rendering], Tensor]:
    """A loss that depends on every number of an image."""
    return lambda image: _loss(image.color, image.alpha, image.depth * image.alpha)


@pytest.fixture
def gradients(leaves, loss_of) -> Callable[..., dict[str, Tensor]]:
    """Gradients of that loss with respect to every field of the scene and the pose."""

    def find(render: Renderer, scene: Gaussians, pose: Tensor | None = None, **options) -> dict[str, Tensor]:
        camera = (torch.eye(4, dtype=torch.float64) if pose is None else pose).clone().requires_grad_()
        fields = leaves(scene.to(dtype=render.dtype))
        loss_of(render(fields, camera, **options)).backward()
        found = {name: getattr(fields, name).grad for name in _FIELDS}
        return {**found, "pose": camera.grad}

    return find


@pytest.fixture
def with_threads() -> Callable[[Callable], list]:
    """Results of a function with one, two and three threads."""

    def call(function: Callable) -> list:
        before, results = torch.get_num_threads(), []
        try:
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                results.append(function())
                assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(before)
        return results

    return call


@pytest.fixture
def equals_dense(dense, leaves, gradients) -> Callable[..., None]:
    """Assert that a backend's image and gradients equal those of the dense float64 renderer."""

    def check(
        render: Renderer,
        scene: Gaussians,
        pose: Tensor | None = None,
        *,
        slack: float = 1.0,
        fields: tuple[str, ...] = _FIELDS,
        **options,
    ) -> None:
        pose = torch.eye(4, dtype=torch.float64) if pose is None else pose
        pinhole = options.get("layout") == "pinhole"
        size = options.pop("size", render.size)
        dense_options = {key: options[key] for key in ("kernel", "order", "lowpass", "near") if key in options}
        fov = options.get("vertical_fov_degrees", 90.0) if pinhole else None
        # The scene is rounded to the backend's type first, for the dense renderer too.
        truth = leaves(scene.to(dtype=render.dtype).to(dtype=torch.float64))
        color, alpha, weighted_depth = dense(truth, pose, size, fov=fov, **dense_options)
        got = render(scene, pose, size=size, **options)
        for found, expected in ((got.color, color), (got.alpha, alpha), (got.depth * got.alpha, weighted_depth)):
            scale = max(1.0, float(expected.detach().abs().max()))
            error = float((found - expected.detach()).abs().max())
            assert error <= slack * render.image * scale, f"image off by {error:.2g}"
        _loss(color, alpha, weighted_depth).backward()
        gradients_found = gradients(render, scene, pose, size=size, **options)
        for name in fields:
            expected, found = getattr(truth, name).grad, gradients_found[name]
            assert torch.isfinite(found).all(), name
            norm = max(float(expected.norm()), 1e-6)  # a sphere's quaternion has only rounding errors as gradient
            error = float((found - expected).norm()) / norm
            assert error <= slack * render.gradient, f"gradient of {name} off by {error:.2g}"

    return check
