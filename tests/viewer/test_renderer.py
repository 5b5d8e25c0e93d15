"""What the settings select: views, blending, levels, thresholds, backgrounds; and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pansplat.errors import InputError
from pansplat.rendering import blend, blend_weights
from pansplat_viewer.renderer import DrawSettings, SplatRenderer

pytestmark = pytest.mark.gl

SIZE = (64, 48)
SETTINGS = DrawSettings(background=(0.1, 0.4, 0.7))


def only(scene, mask):
    return replace(scene, gaussians=scene.gaussians.select(mask))


def view_of(scene, view):
    return only(scene, scene.gaussians.views == view)


@pytest.mark.parametrize("view", [0, 1])
def test_mode_view_draws_that_views_gaussians(renderer, random_scene, pose, reference, assert_same, view):
    scene = random_scene()
    drawn = renderer(scene)
    drawn.render(pose, SIZE, replace(SETTINGS, mode="view", view=view))
    assert_same(drawn, reference(view_of(scene, view), pose, SIZE, SETTINGS))
    assert drawn.stats.visible <= int((scene.gaussians.views == view).sum())


@pytest.mark.parametrize("layout", ["pinhole", "equirect"])
@pytest.mark.parametrize("place", ["between", "at view 1", "elsewhere"])
def test_deferred_blending_is_the_references(renderer, random_scene, pose, reference, assert_same, layout, place):
    scene = random_scene(120)  # sparse, so that there are holes in one view and in both
    centres = scene.cam2world[:, :3, 3].numpy()
    pose[:3, 3] = {"between": centres.mean(0), "at view 1": centres[1], "elsewhere": (0.1, 0.2, 0.3)}[place]
    settings = replace(SETTINGS, mode="deferred", layout=layout)
    drawn = renderer(scene)
    drawn.render(pose, SIZE, settings)
    pictures = [reference(view_of(scene, view), pose, SIZE, settings) for view in (0, 1)]
    weights = blend_weights(torch.from_numpy(pose[:3, 3].copy()), scene.cam2world[:, :3, 3])
    total = sum(weight * picture.alpha for weight, picture in zip(weights, pictures, strict=True))
    band = (total > 0) & (total < 1e-3)  # where the views that count are all but empty (docs/rendering.md, section 7)
    assert band.float().mean() < 0.02
    assert_same(drawn, blend(pictures, weights), ~band.numpy())


def test_difference_is_that_of_the_two_views_pictures(renderer, random_scene, pose, reference):
    scene = random_scene()
    drawn = renderer(scene)
    drawn.render(pose, SIZE, replace(SETTINGS, mode="difference"))
    first, second = (reference(view_of(scene, view), pose, SIZE, SETTINGS) for view in (0, 1))
    expected = (first.color - second.color).abs().permute(1, 2, 0).numpy()
    assert np.abs(drawn.read_color()[..., :3] - expected).max() <= 5e-3
    assert np.abs(drawn.read_depth() - (first.depth - second.depth).abs().numpy()).mean() <= 1e-3
    forwards = drawn.read_color()
    drawn.render(pose, SIZE, replace(SETTINGS, mode="difference", view=1))
    assert np.abs(drawn.read_color() - forwards).max() <= 1e-6


@pytest.mark.parametrize("levels", [frozenset(), frozenset({0}), frozenset({1, 3})])
def test_levels_select_gaussians(renderer, random_scene, pose, reference, assert_same, levels):
    scene = random_scene()
    drawn = renderer(scene)
    drawn.render(pose, SIZE, replace(SETTINGS, levels=levels))
    mask = torch.isin(scene.gaussians.levels, torch.tensor(sorted(levels), dtype=torch.int64))
    assert_same(drawn, reference(only(scene, mask), pose, SIZE, SETTINGS))


def test_opacity_threshold_leaves_out_the_fainter(renderer, random_scene, pose, reference, assert_same):
    scene = random_scene()
    drawn = renderer(scene)
    drawn.render(pose, SIZE, replace(SETTINGS, opacity_threshold=0.6))
    assert_same(drawn, reference(only(scene, scene.gaussians.opacities >= 0.6), pose, SIZE, SETTINGS))


def test_empty_scene_is_the_background(renderer, random_scene, pose):
    scene = random_scene()
    drawn = renderer(only(scene, torch.zeros(len(scene.gaussians), dtype=torch.bool)))
    for settings in (SETTINGS, replace(SETTINGS, layout="equirect", mode="deferred")):
        drawn.render(pose, SIZE, settings)
        assert np.allclose(drawn.read_color(), (*SETTINGS.background, 0), atol=1e-6)
        assert not drawn.read_depth().any()


def test_gaussians_that_are_not_finite_are_left_out_and_counted(renderer, random_scene, pose, reference, assert_same):
    scene = random_scene()
    poisoned = {name: getattr(scene.gaussians, name).clone() for name in ("means", "scales", "quats", "opacities")}
    harmonics = scene.gaussians.harmonics.clone()
    poisoned["means"][0, 1] = float("nan")
    poisoned["scales"][1, 0] = float("inf")
    poisoned["quats"][2, 3] = float("nan")
    poisoned["opacities"][3] = float("nan")
    harmonics[4, 2, 0] = float("-inf")
    drawn = renderer(replace(scene, gaussians=replace(scene.gaussians, harmonics=harmonics, **poisoned)))
    drawn.render(pose, SIZE, SETTINGS)
    assert drawn.stats.dropped == 5
    assert drawn.stats.total == len(scene.gaussians) - 5
    healthy = only(scene, torch.arange(len(scene.gaussians)) >= 5)
    assert_same(drawn, reference(healthy, pose, SIZE, SETTINGS))


def test_half_float_targets_are_close(renderer, random_scene, pose):
    scene = random_scene()
    exact, half = renderer(scene), renderer(scene, color_bits=16)
    exact.render(pose, SIZE, SETTINGS)
    half.render(pose, SIZE, SETTINGS)
    assert 0 < np.abs(exact.read_color() - half.read_color()).max() < 0.02


def test_software_gl_gets_full_floats_by_default(ctx, random_scene, pose):
    class Gpu:
        """The same context under a GPU's name."""

        def __init__(self):
            self.info = {**ctx.info, "GL_RENDERER": "NVIDIA H200"}

        def __getattr__(self, name):
            return getattr(ctx, name)

    for context, dtype in ((ctx, "f4" if "llvmpipe" in ctx.info["GL_RENDERER"] else "f2"), (Gpu(), "f2")):
        drawn = SplatRenderer(context)
        drawn.upload(random_scene(20))
        assert drawn.render(pose, SIZE, SETTINGS).dtype == dtype
        drawn.release()


def test_top_row_is_up_and_right_is_right(renderer, random_scene):
    """One Gaussian ahead, up (-y) and to the right is upper right; the texture holds the bottom row first."""
    scene = only(random_scene(), torch.arange(300) < 1)
    gaussians = replace(scene.gaussians, means=torch.tensor(((0.5, -0.5, 1.0),)), opacities=torch.ones(1))
    drawn = renderer(replace(scene, gaussians=replace(gaussians, scales=torch.full((1, 3), 0.05))))
    texture = drawn.render(np.eye(4), (64, 64), DrawSettings())
    row, column = np.unravel_index(drawn.read_color()[..., 3].argmax(), (64, 64))
    assert row < 24 and column > 40
    raw = np.frombuffer(texture.read(), np.float32).reshape(64, 64, 4)
    assert np.array_equal(raw[::-1], drawn.read_color())


def test_wide_and_tiled_culling_changes_nothing(renderer, random_scene, pose, monkeypatch):
    """Culling on the CPU must keep whatever the shaders would draw."""
    from pansplat_viewer.splats import SortedSplats

    scene = random_scene(1000, size=0.1)
    settings = [replace(SETTINGS, vertical_fov_degrees=fov) for fov in (10, 60, 150)]
    culled, whole = renderer(scene), renderer(scene)
    pictures = []
    for each in settings:
        culled.render(pose, SIZE, each)
        assert culled.stats.drawn < 1000
        pictures.append(culled.read_color())
    monkeypatch.setattr(SortedSplats, "cull", lambda self, camera, selected, **_: selected)
    for each, picture in zip(settings, pictures, strict=True):
        whole.render(pose, SIZE, each)
        assert np.array_equal(whole.read_color(), picture)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mode": "view", "view": 2}, "`view` must be 0..1 in this scene, got 2"),
        ({"layout": "equirect", "face_size": 100_000}, "limit is .*; use a smaller size or face_size"),
    ],
)
def test_settings_that_do_not_fit_are_refused(renderer, random_scene, pose, change, message):
    drawn = renderer(random_scene())
    with pytest.raises(InputError, match=message):
        drawn.render(pose, SIZE, replace(SETTINGS, **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kernel": "surfel"}, "`kernel` must be one of ray, ewa, got 'surfel'"),
        ({"vertical_fov_degrees": 180}, "between 0 and 180, got 180"),
        ({"face_size": 0}, "`face_size` must be at least 1"),
        ({"near": 0.0}, "`near` must be a positive distance"),
    ],
)
def test_settings_check_themselves(change, message):
    with pytest.raises(InputError, match=message):
        DrawSettings(**change)


def test_bad_poses_sizes_and_a_missing_scene_are_refused(renderer, random_scene, pose, ctx):
    drawn = renderer(random_scene())
    with pytest.raises(InputError, match="finite 4x4"):
        drawn.render(np.full((4, 4), np.nan), SIZE, SETTINGS)
    with pytest.raises(InputError, match="at least 1x1"):
        drawn.render(pose, (0, 10), SETTINGS)
    with pytest.raises(InputError, match="color_bits"):
        SplatRenderer(ctx, color_bits=8)
    empty = SplatRenderer(ctx)
    with pytest.raises(InputError, match="call `upload` first"):
        empty.render(pose, SIZE, SETTINGS)
    with pytest.raises(InputError, match="call `render` first"):
        empty.read_color()
    empty.release()


def test_deferred_without_cameras_is_refused(renderer, random_scene, pose):
    scene = replace(random_scene(), cam2world=torch.zeros(0, 4, 4, dtype=torch.float64), names=())
    drawn = renderer(scene)
    drawn.render(pose, SIZE, SETTINGS)
    with pytest.raises(InputError, match="0 cameras for 2 views; use mode joint"):
        drawn.render(pose, SIZE, replace(SETTINGS, mode="deferred"))
