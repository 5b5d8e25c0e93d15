"""The function `rasterize`: arguments, channels, rotations, layouts and torch.compile."""

import dataclasses
import math

import pytest
import torch
from dense_renderer import POSE, make_scene
from refusals import expect_error
from torch._dynamo.utils import counters

from pansplat.bench.scenes import full_lattice_room
from pansplat.rendering import rasterize

_ORIGIN = torch.eye(4, dtype=torch.float64)


def test_arguments_out_of_range_are_refused(unchecked):
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
        expect_error(message, rasterize, scene, POSE, **{"size": (4, 8), **options})
    for bad in (2 * POSE, torch.diag(torch.tensor((1.0, 1, -1, 1))), POSE * math.nan, torch.eye(3)):
        expect_error("`cam2world` must be a rigid 4x4", rasterize, scene, bad, size=(4, 8))
    with pytest.raises(TypeError, match="unexpected keyword argument 'sharpness'"):
        rasterize(scene, POSE, size=(4, 8), sharpness=2)


def test_the_default_background_is_black_for_any_number_of_channels():
    scene = make_scene(3)
    for channels in (1, 5):
        one = dataclasses.replace(scene, harmonics=torch.zeros(3, 1, channels, dtype=torch.float64))
        got = rasterize(one, POSE, size=(4, 8))
        assert torch.allclose(got.color, 0.5 * got.alpha.expand(channels, 4, 8), rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.filterwarnings("ignore:The .grad attribute")  # the compiler reads it
def test_a_compiled_step_has_the_same_gradients_without_tracing_the_rasteriser():
    gaussians, results = full_lattice_room(16), []

    def loss(means: torch.Tensor) -> torch.Tensor:
        moved = dataclasses.replace(gaussians, means=means * 1.01)
        return rasterize(moved, _ORIGIN, size=(16, 32), backend="numba").color.square().sum()

    torch._dynamo.reset()
    counters.clear()
    for step in (loss, torch.compile(loss, backend="aot_eager")):
        means = gaussians.means.clone().requires_grad_()
        results += torch.autograd.grad(step(means), means)
    torch.testing.assert_close(*results, rtol=1e-5, atol=1e-6 * float(results[0].abs().max()))
    assert any("torch.compiler.disable" in reason for reason in counters["graph_break"])
    assert sum(counters["graph_break"].values()) <= 4  # around `rasterize`; tracing it gives dozens
