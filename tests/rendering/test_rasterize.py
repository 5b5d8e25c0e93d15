"""The function `rasterize`: arguments, channels, rotations, layouts and torch.compile."""

import dataclasses
import math

import pytest
import torch
from refusals import expect_error
from torch._dynamo.utils import counters

from pansplat.bench.scenes import full_lattice_room
from pansplat.gaussians.scene import Gaussians
from pansplat.rendering import rasterize
from pansplat.rendering.rasterize import RasterOptions

_ORIGIN = torch.eye(4, dtype=torch.float64)


# --- arguments ---


def test_arguments_out_of_range_are_refused(make_scene, pose, unchecked):
    scene = make_scene(2)
    official = {"layout": "cubemap", "kernel": "ewa"}
    cases = [
        ({"size": (0, 4)}, r"`size` must be \(height, width\).*\(0, 4\)"),
        ({"layout": "fisheye"}, r"`layout` must be one of equirect, cubemap, pinhole, got 'fisheye'"),
        ({"kernel": "box"}, "`kernel` must be one of ray, ewa"),
        ({"backend": "cuda"}, "`backend` must be one of auto, torch"),
        ({"near": 0.0}, "`near` must be a positive distance"),
        ({"vertical_fov_degrees": 180.0}, "`vertical_fov_degrees` must lie between 0 and 180"),
        ({"face_size": 0}, "`face_size` must be at least 1"),
        ({"eye_offset": math.nan}, "`eye_offset` must be from -1000000.0 to 1000000.0 metres, got nan"),
        ({"eye_offset": 0.1, "layout": "cubemap"}, "viewing circle of layout 'equirect', got layout 'cubemap'"),
        ({"kernel": "ewa"}, "'ewa' .* not defined on layout 'equirect'; use layout='cubemap'"),
        ({**official, "size": (6, 12)}, "'ewa' on layout 'cubemap' needs a 2:1 panorama with a height that is a multi"),
        ({**official, "size": (8, 12)}, "'ewa' on layout 'cubemap' needs a 2:1 panorama with a height that is a multi"),
        ({"background": (0.1, 0.2)}, r"`background` must hold 3 numbers, .* got \(2,\)"),
    ]
    for options, message in cases:
        expect_error(message, rasterize, scene, pose, **{"size": (4, 8), **options})
    for bad in (2 * pose, torch.diag(torch.tensor((1.0, 1, -1, 1))), pose * math.nan, torch.eye(3)):
        expect_error("`cam2world` must be a rigid 4x4", rasterize, scene, bad, size=(4, 8))
    with pytest.raises(TypeError, match="unexpected keyword argument 'sharpness'"):
        rasterize(scene, pose, size=(4, 8), sharpness=2)


def test_keywords_are_the_fields_of_the_options(make_scene, pose):
    scene, place = make_scene(20), dict(size=(16, 32), layout="cubemap", face_size=8)
    plain = rasterize(scene, pose, **place).color
    for options in (RasterOptions(), RasterOptions("ewa"), RasterOptions(near=1.0)):
        is_plain = torch.equal(rasterize(scene, pose, **place, **vars(options)).color, plain)
        assert is_plain == (options == RasterOptions()), options


# --- channels ---


def test_the_default_background_is_black_for_any_number_of_channels(make_scene, pose):
    scene = make_scene(3)
    for channels in (1, 5):
        one = dataclasses.replace(scene, harmonics=torch.zeros(3, 1, channels, dtype=torch.float64))
        got = rasterize(one, pose, size=(4, 8))
        assert torch.allclose(got.color, 0.5 * got.alpha.expand(channels, 4, 8), rtol=0, atol=1e-12)


# --- torch.compile ---


def _loss(gaussians: Gaussians, backend: str) -> torch.Tensor:
    moved = dataclasses.replace(gaussians, means=gaussians.means * 1.01, scales=gaussians.scales.log().exp())
    got = rasterize(moved, _ORIGIN, size=(16, 32), backend=backend)
    return got.color.square().sum() + 0.1 * got.depth.sum() + got.alpha.sum()


def _gradients(loss, gaussians: Gaussians, backend: str):
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in ("means", "scales", "opacities")}
    value = loss(dataclasses.replace(gaussians, **leaves), backend)
    return value.detach(), torch.autograd.grad(value, list(leaves.values()))


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.filterwarnings("ignore:The .grad attribute")  # the compiler reads it
@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_a_compiled_step_has_the_same_loss_and_gradients_without_tracing_the_rasteriser(backend):
    gaussians = full_lattice_room(16)
    torch._dynamo.reset()
    counters.clear()
    value, gradients = _gradients(torch.compile(_loss, backend="aot_eager"), gaussians, backend)
    plain, expected = _gradients(_loss, gaussians, backend)
    assert torch.allclose(value, plain, rtol=1e-6)
    for found, right in zip(gradients, expected, strict=True):
        assert torch.allclose(found, right, rtol=1e-5, atol=1e-6 * right.abs().max())
    assert counters["frames"]["total"] > 0
    assert any("torch.compiler.disable" in reason for reason in counters["graph_break"])
    assert sum(counters["graph_break"].values()) <= 4  # around `rasterize`; tracing it gives dozens
