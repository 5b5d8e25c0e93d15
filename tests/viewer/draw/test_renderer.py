"""GL images equal the torch reference (docs/rendering.md); settings select Gaussians; invalid input is refused."""

import math
from dataclasses import replace

import moderngl
import numpy as np
import pytest
import torch
from refusals import expect_error

from pansplat.geometry.cubemap import face_poses
from pansplat.geometry.pose import quats_from_rotations, rotations_from_quats
from pansplat.rendering import blend, blend_weights
from pansplat_viewer.draw.programs import Programs
from pansplat_viewer.draw.renderer import DrawSettings, SplatRenderer
from pansplat_viewer.draw.splats import SortedSplats

pytestmark = pytest.mark.gl

SIZE = (64, 48)
SETTINGS = DrawSettings(background=(0.1, 0.4, 0.7))
RENDERERS = pytest.mark.parametrize("renderer_name", ["gl", "cpu"])


def blur(scene, pose, shift):
    """The scene with Gaussians that are widened by the movement of a camera, in float64."""
    own = scene.gaussians
    means, quats, scales = (each.double() for each in (own.means, own.quats, own.scales))
    rays = means - torch.from_numpy(pose[:3, 3])
    n = torch.nn.functional.normalize(rays, dim=1)
    axes = rotations_from_quats(quats) * scales[:, None]
    motion = (n * (n @ torch.tensor(shift).double())[:, None] - torch.tensor(shift).double()) / math.sqrt(12)
    across = torch.eye(3) - n[:, :, None] * n[:, None]
    before, after = axes @ axes.mT, axes @ axes.mT + motion[:, :, None] * motion[:, None]
    area = [torch.linalg.det(across @ each @ across + n[:, :, None] * n[:, None]) for each in (before, after)]
    variances, vectors = torch.linalg.eigh(after)
    vectors = vectors * torch.linalg.det(vectors).sign()[:, None, None]
    fields = {
        "quats": quats_from_rotations(vectors).float(),
        "scales": variances.clamp_min(0).sqrt().float(),
        "opacities": scene.gaussians.opacities * (area[0] / area[1]).sqrt().float(),
    }
    return change(scene, **fields)


def select(scene, mask):
    return replace(scene, gaussians=scene.gaussians.select(mask))


def select_view(scene, view):
    return select(scene, scene.gaussians.views == view)


def change(scene, **fields):
    return replace(scene, gaussians=replace(scene.gaussians, **fields))


def make_cases(name, random_scene, pose):
    """Scene, pose, size and settings of images of a hard case, and perhaps the scene that the reference draws."""
    scene, opacities = random_scene(), random_scene().gaussians.opacities
    if name == "pinhole":
        yield scene, pose, (97, 64), {"vertical_fov_degrees": 65}
    elif name == "six faces":
        for face in face_poses(torch.from_numpy(pose)).numpy():
            yield scene, face, (48, 48), {}
    elif name == "among large Gaussians":
        yield random_scene(150, size=0.5, seed=3), pose, SIZE, {"vertical_fov_degrees": 110}
    elif name == "smaller than a pixel, needles and discs":
        scales = scene.gaussians.scales.clone()
        scales[:100] *= 0.01
        scales[100:200, 0] *= 30
        scales[200:, 1] = 0
        yield change(scene, scales=scales), pose, (80, 60), {}
    elif name == "colours of any degree follow the position":
        for degree, shift in ((0, 0.0), (2, 0.5), (4, 0.5)):
            moved = pose.copy()
            moved[0, 3] += shift
            yield random_scene(degree=degree, seed=5), moved, SIZE, {}
    elif name == "ties are drawn in the order of indices":
        tied = random_scene(60, degree=0, size=0.15, seed=6)  # six of different colour at each position
        yield change(tied, means=tied.gaussians.means[torch.arange(60) // 6 * 6]), pose, SIZE, {}
    elif name == "near, odd sizes and unusual opacities":
        yield from ((scene, pose, SIZE, {"near": near, "background": (0.0, 0.0, 0.0)}) for near in (1.5, 2.5))
        yield from ((scene, pose, size, {}) for size in ((1, 1), (2, 1), (31, 7), (7, 31)))
        unusual = opacities * 4 - 1
        unusual[::7] = 0.99 / 255
        yield change(scene, opacities=unusual), pose, SIZE, {}
    elif name == "a moving camera":
        for shift in ((0.3, 0.0, 0.2), (0.0, 0.02, -0.1)):
            yield scene, pose, SIZE, {"shift": shift, "near": 0.5}, blur(scene, pose, shift)
    elif name == "the Gaussians of a view and of levels":
        for view in (0, 1):
            yield scene, pose, SIZE, {"mode": "view", "view": view}, select_view(scene, view)
        for levels in ((), (0,), (1, 3)):
            mask = torch.isin(scene.gaussians.levels, torch.tensor(levels, dtype=torch.int64))
            yield scene, pose, SIZE, {"levels": frozenset(levels)}, select(scene, mask)
    elif name == "values that are not finite are dropped":
        fields = ("means", "scales", "quats", "opacities", "harmonics")
        broken = {each: getattr(scene.gaussians, each).clone() for each in fields}
        for row, (each, value) in enumerate(
            zip(fields, (math.nan, math.inf, math.nan, math.nan, -math.inf), strict=True)
        ):
            broken[each][row].flatten()[-1] = value
        yield change(scene, **broken), pose, SIZE, {}, select(scene, torch.arange(300) >= 5)
    else:
        raise AssertionError(name)


@pytest.mark.parametrize(
    "name",
    [
        *("pinhole", "six faces", "among large Gaussians", "smaller than a pixel, needles and discs"),
        *("colours of any degree follow the position", "ties are drawn in the order of indices"),
        *("near, odd sizes and unusual opacities", "a moving camera", "the Gaussians of a view and of levels"),
        "values that are not finite are dropped",
    ],
)
def test_opengl_and_the_processor_draw_the_reference(name, random_scene, pose, assert_reference):
    for scene, camera, size, changes, *drawn in make_cases(name, random_scene, pose):
        assert_reference(scene, camera, size, replace(SETTINGS, **changes), *drawn)


@RENDERERS
def test_image_does_not_depend_on_the_unit_of_length_and_the_origin(make_renderer, random_scene, pose, renderer_name):
    unit, origin = 1e3, torch.tensor((4e8, -2e8, 1e8), dtype=torch.float64)
    scene = random_scene(seed=7)
    renderer = make_renderer(scene, renderer_name)
    renderer.render(pose, SIZE, DrawSettings())
    expected = renderer.read_color()
    cam2world = scene.cam2world.clone()
    cam2world[:, :3, 3] = cam2world[:, :3, 3] * unit + origin
    gaussians = scene.gaussians.to(dtype=torch.float64)
    gaussians = replace(gaussians, means=gaussians.means * unit + origin, scales=gaussians.scales * unit)
    renderer.upload(replace(scene, gaussians=gaussians, cam2world=cam2world))
    pose[:3, 3] = pose[:3, 3] * unit + origin.numpy()
    renderer.render(pose, SIZE, DrawSettings(near=0.05 * unit))
    assert np.abs(renderer.read_color() - expected).max() <= 5e-3
    assert np.abs(renderer.read_color() - expected).mean() <= 1e-5


@RENDERERS
@pytest.mark.parametrize("position", ["between", "at view 1", "elsewhere"])
def test_deferred_blending_equals_the_reference(
    make_renderer, random_scene, pose, reference, assert_matches, position, renderer_name
):
    scene = random_scene(120)  # sparse, so that one or both views have holes
    centers = scene.cam2world[:, :3, 3].numpy()
    pose[:3, 3] = {"between": centers.mean(0), "at view 1": centers[1], "elsewhere": (0.1, 0.2, 0.3)}[position]
    settings = replace(SETTINGS, mode="deferred")
    renderer = make_renderer(scene, renderer_name)
    images = [reference(select_view(scene, view), pose, SIZE, settings) for view in (0, 1)]
    forward = torch.from_numpy(pose[:3, 2].copy())
    weights = blend_weights(torch.from_numpy(pose[:3, 3].copy()), scene.cam2world[:, :3, 3], forward)
    total = sum(weight * image.alpha for weight, image in zip(weights, images, strict=True))
    band = (total > 0) & (total < 1e-3)  # where the weighted views are nearly empty (docs/rendering.md, section 7)
    assert band.float().mean() < 0.02
    assert_matches(renderer, pose, settings, blend(images, weights), ~band.numpy())


@RENDERERS
def test_empty_scene_is_the_background(make_renderer, random_scene, pose, renderer_name):
    scene = random_scene()
    renderer = make_renderer(select(scene, torch.zeros(len(scene.gaussians), dtype=torch.bool)), renderer_name)
    for settings in (SETTINGS, replace(SETTINGS, mode="deferred")):
        renderer.render(pose, SIZE, settings)
        assert np.allclose(renderer.read_color(), (*SETTINGS.background, 0), atol=1e-6)
        assert not renderer.read_depth().any()


def test_half_float_targets_are_close(make_renderer, random_scene, pose):
    exact, half = make_renderer(random_scene()), make_renderer(random_scene(), color_bits=16)
    for renderer in (exact, half):
        renderer.render(pose, SIZE, SETTINGS)
    assert 0 < np.abs(exact.read_color() - half.read_color()).max() < 0.02


def test_software_gl_has_32_bit_targets_by_default(ctx, random_scene, pose):
    class Gpu:
        """The same context with a GPU's name."""

        def __init__(self):
            self.info = {**ctx.info, "GL_RENDERER": "NVIDIA H200"}

        def __getattr__(self, name):
            return getattr(ctx, name)

    for context, dtype in ((ctx, "f4" if "llvmpipe" in ctx.info["GL_RENDERER"] else "f2"), (Gpu(), "f2")):
        renderer = SplatRenderer(context)
        renderer.upload(random_scene(20))
        assert renderer.render(pose, SIZE, SETTINGS).dtype == dtype
        renderer.release()


@RENDERERS
def test_image_is_upright_and_not_mirrored(make_renderer, random_scene, renderer_name):
    scene = select(random_scene(), torch.arange(300) < 1)
    gaussians = replace(scene.gaussians, means=torch.tensor(((0.5, -0.5, 1.0),)), opacities=torch.ones(1))
    renderer = make_renderer(
        replace(scene, gaussians=replace(gaussians, scales=torch.full((1, 3), 0.05))), renderer_name
    )
    texture = renderer.render(np.eye(4), (64, 64), DrawSettings())
    row, column = np.unravel_index(renderer.read_color()[..., 3].argmax(), (64, 64))
    assert row < 24 and column > 40, "a mean ahead, up and to the right is at the upper right"
    raw = np.frombuffer(texture.read(), np.uint8 if renderer_name == "cpu" else np.float32).reshape(64, 64, 4)
    raw = raw[::-1, :, :3] / (255 if renderer_name == "cpu" else 1)
    error = np.abs(raw - renderer.read_color()[..., :3]).max()
    assert error <= (0.501 / 255 if renderer_name == "cpu" else 0), "row 0 of the texture is the bottom row"


def test_culling_does_not_change_the_image(make_renderer, random_scene, pose, monkeypatch):
    scene = random_scene(1000, size=0.1)
    settings = [replace(SETTINGS, vertical_fov_degrees=fov) for fov in (10, 60, 150)]
    culled, whole = make_renderer(scene), make_renderer(scene, slot=1)
    images, counts, find = [], [], SortedSplats.find_back_to_front
    with monkeypatch.context() as patch:
        patch.setattr(
            SortedSplats, "find_back_to_front", lambda *each: counts.append(len(found := find(*each))) or found
        )
        for each in settings:
            culled.render(pose, SIZE, each)
            images.append(culled.read_color())
    assert max(counts) < 1000
    monkeypatch.setattr(
        SortedSplats, "find_back_to_front", lambda self, camera, selected, _: self.order[selected[self.order]][::-1]
    )
    for each, image in zip(settings, images, strict=True):
        whole.render(pose, SIZE, each)
        assert np.array_equal(whole.read_color(), image)


@RENDERERS
def test_settings_poses_and_sizes_that_do_not_fit_are_refused(make_renderer, random_scene, pose, renderer_name):
    scene = random_scene()
    renderer = make_renderer(scene, renderer_name)
    expect_error("`view` .* got 2", lambda: renderer.render(pose, SIZE, replace(SETTINGS, mode="view", view=2)))
    expect_error("limit is", lambda: renderer.render(pose, (200_000, 100_000), SETTINGS))
    expect_error("finite 4x4", lambda: renderer.render(np.full((4, 4), np.nan), SIZE, SETTINGS))
    expect_error("at least 1x1", renderer.render, pose, (0, 10), SETTINGS)
    renderer.upload(replace(scene, cam2world=torch.zeros(0, 4, 4, dtype=torch.float64), names=()))
    renderer.render(pose, SIZE, SETTINGS)
    expect_error("0 cameras for 2 views", lambda: renderer.render(pose, SIZE, replace(SETTINGS, mode="deferred")))


def test_a_renderer_without_a_scene_is_refused(ctx, pose):
    empty = SplatRenderer(ctx)
    expect_error("call `upload` first", empty.render, pose, SIZE, SETTINGS)
    for read in (empty.read_color, empty.read_depth):
        expect_error("call `render` first", read)
    empty.release()


@RENDERERS
def test_a_failed_upload_keeps_the_scene_before(make_renderer, random_scene, pose, renderer_name, monkeypatch):
    renderer, compile_splat, failures = make_renderer(random_scene(), renderer_name), Programs.splat, [True]
    renderer.render(pose, SIZE, SETTINGS)
    expected = renderer.read_color()

    def fail_once(*arguments, **options):
        if failures.pop() if failures else False:
            raise moderngl.Error("out of memory")
        return compile_splat(*arguments, **options)

    with monkeypatch.context() as patch:  # when most of the buffers are allocated
        patch.setattr(Programs, "splat", fail_once)
        patch.setattr("pansplat_viewer.draw.cpu_renderer.DisplayScene", fail_once)
        with pytest.raises(moderngl.Error, match="out of memory"):
            renderer.upload(random_scene(seed=1))
    renderer.render(pose, SIZE, SETTINGS)
    assert np.array_equal(renderer.read_color(), expected)
