"""The Gaussians of surfaces."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pansplat.evaluation.metrics import psnr
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import lattice_size
from pansplat.geometry.pose import interpolate_poses, rotations_from_quats
from pansplat.rendering import blend, blend_weights, rasterize
from pansplat.sweep import lift as module
from pansplat.sweep.lift import (
    _BACKGROUND_DEPTH,
    _FOOTPRINT,
    NUM_LEVELS,
)
from pansplat.sweep.lift import lift as lift_views
from pansplat.sweep.surface import PosedImages, Surface


def lift(posed: PosedImages, surfaces: list[Surface]) -> Gaussians:
    """Lift each view with all others as its neighbours."""
    views = range(len(surfaces))
    return lift_views(posed, surfaces, [[other for other in views if other != view] for view in views])


@pytest.fixture(scope="module")
def gaussians(small_furnished_room) -> Gaussians:
    return lift(small_furnished_room.posed, small_furnished_room.surfaces)


@pytest.fixture(scope="module")
def exact(small_furnished_room) -> Gaussians:
    """Of the true depth."""
    return lift(small_furnished_room.posed, small_furnished_room.make_exact_surfaces())


def _render(gaussians: Gaussians, observed, pose: np.ndarray):
    """The rendering at a pose with deferred blending."""
    cam2world = torch.from_numpy(observed.posed.cam2world)
    weights = blend_weights(torch.from_numpy(pose[:3, 3]), cam2world[:, :3, 3])
    renderings = [
        rasterize(gaussians.select(gaussians.views == view), torch.from_numpy(pose), size=(64, 128))
        for view in range(len(cam2world))
    ]
    return blend(renderings, weights)


def _middle(observed) -> np.ndarray:
    return interpolate_poses(*torch.from_numpy(observed.posed.cam2world), 0.5).numpy()


def test_gaussians_are_valid_and_no_level_has_more_than_its_lattice_has_points(gaussians):
    for values in dataclasses.astuple(gaussians):
        assert torch.isfinite(values.double()).all()
    assert (gaussians.scales > 0).all()
    assert torch.allclose(gaussians.quats.norm(dim=1), torch.ones(len(gaussians)), atol=1e-5)
    assert (gaussians.opacities > 0).all() and (gaussians.opacities <= 1).all()
    for level in range(NUM_LEVELS):
        for view in (0, 1):
            count = int(((gaussians.levels == level) & (gaussians.views == view)).sum())
            assert 0 < count <= lattice_size(128 >> level)


def test_discs_lie_on_the_surface(small_furnished_room, exact):
    """Fine means in the room's planes, and the discs' thin axes along the planes' normals."""
    fine = exact.select(exact.levels == 0)
    distances = small_furnished_room.room.wall_distances(fine.means.numpy())
    on_wall = distances.min(axis=1) < 0.05
    assert on_wall.mean() > 0.7  # the rest is on the box, or at a discontinuity
    axis = distances.argmin(axis=1) % 3
    thin = rotations_from_quats(fine.quats).numpy()[:, :, 2]
    cosine = np.abs(thin[np.arange(len(axis)), axis])[on_wall]
    assert np.median(cosine) > 0.99
    assert (cosine > 0.9).mean() > 0.8


def test_the_room_is_rendered_between_the_inputs(small_furnished_room, exact):
    pose = _middle(small_furnished_room)
    truth, depth = small_furnished_room.room.cast(pose, 64)
    rendering = _render(exact, small_furnished_room, pose)
    assert psnr(rendering.color, torch.from_numpy(truth).permute(2, 0, 1)) > 22
    assert np.median(np.abs(rendering.depth.numpy() / depth - 1)) < 0.05


@pytest.mark.parametrize("place", (0.0, 0.25, 0.5))
def test_there_are_no_holes_between_the_inputs(small_furnished_room, gaussians, place):
    pose = interpolate_poses(*torch.from_numpy(small_furnished_room.posed.cam2world), place).numpy()
    assert _render(gaussians, small_furnished_room, pose).alpha.min() > 0.9


@pytest.mark.parametrize("scene", ("gaussians", "exact"))
def test_no_gaussian_contains_a_camera(small_furnished_room, scene, request):
    """A Gaussian reaches 3.33 standard deviations; from inside it would cover the whole panorama."""
    gaussians = request.getfixturevalue(scene)
    axes = rotations_from_quats(gaussians.quats).double()
    for pose in small_furnished_room.posed.cam2world:
        away = torch.from_numpy(pose[:3, 3]) - gaussians.means.double()
        local = torch.einsum("nij,ni->nj", axes, away) / gaussians.scales.double()
        assert local.norm(dim=1).min() > 3.33


def test_masked_pixels_make_no_gaussians(small_furnished_room):
    posed, surfaces = small_furnished_room.posed, small_furnished_room.make_exact_surfaces()
    masks = posed.masks.copy()
    masks[0, -16:] = False  # the nadir, 45 degrees and steeper
    masks[1] = False
    gaussians = lift(dataclasses.replace(posed, masks=masks), surfaces)
    assert (gaussians.views == 0).all()
    own = gaussians.means.double().numpy() - posed.cam2world[0, :3, 3]
    steep = np.degrees(np.arcsin(own[:, 1] / np.linalg.norm(own, axis=1)))
    assert steep.max() < 45.01 and steep.min() < -85


def _sphere_around(image: np.ndarray) -> tuple[PosedImages, list[Surface]]:
    """A panorama on a sphere of 3 m, seen by two coincident cameras."""
    height = image.shape[0]
    inverse = np.full((height, 2 * height), 1 / 3, np.float32)
    masks = np.ones((2, height, 2 * height), bool)
    posed = PosedImages(np.stack((image, image)), np.stack((np.eye(4), np.eye(4))), masks, 0.5, 8.0)
    return posed, [Surface(inverse)] * 2


def test_only_image_detail_makes_gaussians_of_level_0():
    white = np.ones((64, 128, 3), np.float32)
    noise = np.random.default_rng(0).random((64, 128, 3)).astype(np.float32)
    half = np.where(np.arange(128)[None, :, None] < 64, white, noise)
    fine = [int((lift(*_sphere_around(image)).levels == 0).sum()) for image in (white, half, noise)]
    assert fine[0] == 0
    assert fine[2] == 2 * lattice_size(128)
    assert 0.5 * fine[2] < fine[1] < 0.6 * fine[2]


def test_gaussians_of_a_sphere_lie_on_the_fibonacci_lattices_at_its_radius():
    gaussians = lift(*_sphere_around(np.ones((64, 128, 3), np.float32)))
    radius = gaussians.means.norm(dim=1)
    for level, factor in zip((1, 2, 3), (1.0, *_BACKGROUND_DEPTH), strict=True):
        depth = 3.0 * factor
        chosen = gaussians.levels == level
        assert int(chosen.sum()) == 2 * lattice_size(128 >> level)
        assert torch.allclose(radius[chosen], torch.tensor(depth), rtol=1e-4)
        size = _FOOTPRINT * math.sqrt(4 * math.pi / lattice_size(128 >> level)) * depth
        assert torch.allclose(gaussians.scales[chosen][:, :2], torch.tensor(size), rtol=1e-3)


def test_points_in_the_consistent_free_space_of_another_view_are_dropped(make_room):
    room = make_room()
    observed = room.observe(64, [*room.two_poses(), room.pose((0.1, -0.1, -0.6))])
    surfaces = observed.make_exact_surfaces()
    surfaces[0].inverse_depth[20:30, 50:70] *= 2.0  # a surface in the free space of the other views
    gaussians = lift(observed.posed, surfaces)
    for level in (0, 1):
        chosen = (gaussians.views == 0) & (gaussians.levels == level)
        assert (room.wall_distances(gaussians.means[chosen].numpy()).min(axis=1) < 0.15).mean() > 0.97


@pytest.fixture
def detailed(monkeypatch) -> tuple[PosedImages, list[Surface]]:
    """Two cameras in a sphere; noise to the north, one colour elsewhere. Points have 32, 64 and 128 rows."""
    monkeypatch.setattr(module, "_SURFACE_HEIGHT", 32)
    image = np.full((128, 256, 3), 0.5, np.float32)
    noise = np.random.default_rng(0).random((20, 30, 3), np.float32)
    image[40:80, 100:160] = noise.repeat(2, axis=0).repeat(2, axis=1)
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 0.02
    posed = PosedImages(np.stack([image, image]), poses, np.ones((2, 128, 256), bool), near=0.5, far=10.0)
    surface = Surface(np.full((32, 64), 0.5, np.float32))
    return posed, [surface, surface]


def _density(gaussians: Gaussians, *, detail: bool) -> float:
    """Points of levels 0 and 1 of view 0 for each point of the lattice of 128 rows, inside or outside of the detail."""
    points = gaussians.select((gaussians.levels < 2) & (gaussians.views == 0)).means
    u = torch.atan2(points[:, 0], points[:, 2]) / (2 * math.pi) + 0.5
    v = torch.asin(points[:, 1] / points.norm(dim=1)) / math.pi + 0.5
    inside = (u > 106 / 256) & (u < 154 / 256) & (v > 46 / 128) & (v < 74 / 128)
    bands = torch.sin(torch.tensor([46 / 128, 74 / 128]) * math.pi - math.pi / 2)
    area = float(bands[1] - bands[0]) / 2 * 48 / 256
    return float(inside.sum()) / (area * lattice_size(256)) if detail else float((~inside).sum()) / lattice_size(256)


def test_finer_lattices_replace_coarser_ones_where_a_large_panorama_has_detail(detailed):
    gaussians = lift(*detailed)
    assert _density(gaussians, detail=True) == pytest.approx(1, abs=0.05)
    assert _density(gaussians, detail=False) < 0.12
    assert gaussians.levels.unique().tolist() == list(range(NUM_LEVELS))


def test_the_limit_of_fine_points_holds(detailed, monkeypatch):
    unlimited, coarse = lift(*detailed), len(lift(detailed[0].resize(32), detailed[1]))
    monkeypatch.setattr(module, "_FINE_POINTS", 400)
    limited = lift(*detailed)
    assert len(limited) < coarse + 2 * 400 < len(unlimited)
