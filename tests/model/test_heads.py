"""Gaussian heads and adapter: tiles, symmetries, gradients, agreement with the official code."""

import dataclasses

import pytest
import torch
from refusals import expect_error
from synthetic_scenes import draw_noise

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import lattice_size
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.cost_volume import Depths, LevelDepth
from pansplat.model.heads import (
    AdapterConfig,
    AuxiliaryHeads,
    GaussianHeads,
    HeadsConfig,
    MatchedViews,
)
from pansplat.model.pansplat import PanSplat
from pansplat.training.network import build_auxiliary_heads

SMALL = HeadsConfig(feature_channels=(6, 5, 4, 3), candidates=4, adapter=AdapterConfig(degree=1))
_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


def _heads(compat="fixed", **changes: object) -> GaussianHeads:
    torch.manual_seed(0)
    return GaussianHeads(dataclasses.replace(SMALL, **changes), compat).double()


def _matched(height: int = 64, views: int = 2, batch: int = 1) -> MatchedViews:
    generator = torch.Generator().manual_seed(1)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(batch, views, *shape, generator=generator, dtype=torch.float64)

    features = [
        random(c, height >> level, 2 * height >> level) for c, level in zip((6, 5, 4, 3), (3, 2, 1, 0), strict=True)
    ]
    sweeps = []
    for level in (3, 2, 1):
        size = (height >> level, 2 * height >> level)
        candidates = random(4, *size).sigmoid() + 0.2
        sweeps.append(LevelDepth(level, candidates[:, :, 0], random(*size).sigmoid(), random(4, *size), candidates))
    poses = torch.eye(4, dtype=torch.float64).repeat(batch, views, 1, 1)
    poses[..., :3, :3] = rotations_from_quats(random(4))
    poses[..., :3, 3] = random(3)
    near, far = torch.full((2, batch, views), 0.5, dtype=torch.float64) * torch.tensor((1, 40))[:, None, None]
    images = random(3, height, 2 * height).sigmoid()
    return MatchedViews(images, features, Depths(tuple(sweeps)), poses, near, far)


def _difference(a: Gaussians, b: Gaussians) -> float:
    assert torch.equal(a.levels, b.levels) and torch.equal(a.views, b.views)
    return max(float((getattr(a, name) - getattr(b, name)).detach().abs().max()) for name in _FIELDS)


@pytest.mark.slow
def test_tiled_heads_equal_untiled():
    heads, matched = _heads(), _matched(views=1)
    with torch.no_grad():
        assert _difference(heads(matched)[0], heads(matched, tiles=4)[0]) < 1e-12


def test_official_tiles_change_the_output():
    heads, matched = _heads("official"), _matched()
    with torch.no_grad():
        parts = list(heads.iterate_tiles(matched, tiles=2))
        tiled = Gaussians.cat([part.gaussians[0] for part in parts])
        assert _difference(heads(matched, tiles=2)[0], tiled) == 0  # in the order of tiles
        index = torch.cat([part.index for part in parts])
        assert _difference(heads(matched)[0], tiled.select(torch.argsort(index))) > 1e-3


@pytest.mark.slow
def test_a_tile_computed_alone_has_the_same_gaussians_and_gradients():
    heads, matched = _heads(), _matched()
    untiled = heads(matched)[0]
    weights = draw_noise(*untiled.means.shape, seed=3)
    (untiled.means * weights).sum().backward()
    expected = [parameter.grad.clone() for parameter in heads.parameters()]
    heads.zero_grad()
    for number in range(4):
        (part,) = heads.iterate_tiles(matched, tiles=2, only=[number])
        assert _difference(part.gaussians[0], untiled.select(part.index)) < 1e-12
        (part.gaussians[0].means * weights[part.index]).sum().backward()
    for parameter, gradient in zip(heads.parameters(), expected, strict=True):
        assert torch.allclose(parameter.grad, gradient, atol=1e-10)


@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_order_is_level_coarse_to_fine_then_view_then_point(compat):
    with torch.no_grad():
        gaussians = _heads(compat)(_matched(views=3))[0]
    expected = [(level, view) for level in (3, 2, 1, 0) for view in range(3) for _ in range(lattice_size(128 >> level))]
    assert list(zip(gaussians.levels.tolist(), gaussians.views.tolist(), strict=True)) == expected


def test_depth_stays_within_its_bounds():
    matched = _matched()
    matched = dataclasses.replace(matched, near=matched.near * 3, far=matched.near * 4)  # candidates lie outside
    with torch.no_grad():
        gaussians = _heads()(matched)[0]
    depths = (gaussians.means - matched.cam2world[0, gaussians.views.long(), :3, 3]).norm(dim=-1)
    assert float(depths.min()) >= 1.5 - 1e-9 and float(depths.max()) <= 2 + 1e-9


def test_swept_depth_is_that_of_the_cost_volume():
    matched, heads = _matched(), _heads(depth="swept")
    with torch.no_grad():
        gaussians = heads(matched)[0]
    swept = matched.depths.levels[-1]
    depths = (gaussians.means - matched.cam2world[0, gaussians.views.long(), :3, 3]).norm(dim=-1)
    for view in range(2):
        of_view = gaussians.views == view
        for values, map_ in ((1 / depths, swept.inverse_depth), (gaussians.opacities, swept.confidence.sigmoid())):
            low, high = map_[0, view].min(), map_[0, view].max()
            inside = (values[of_view] >= low - 1e-9) & (values[of_view] <= high + 1e-9)
            assert inside.all() and values[of_view].std() > 0.3 * map_[0, view].std(), "interpolated"
    assert heads.config.outputs == 2 + 7 + 12


def test_unusable_heights_are_refused():
    expect_error("4x4 tiles on 4 levels need a height that 32 divides, got 80", lambda: _heads()(_matched(80), tiles=4))
    expect_error("at least 56 pixels high, got 48", lambda: _heads()(_matched(48)))


def test_auxiliary_heads_give_a_set_for_each_swept_level():
    torch.manual_seed(0)
    config = HeadsConfig(depth="swept", layers=2, feature_channels=(6, 5, 4), candidates=4, adapter=SMALL.adapter)
    heads = AuxiliaryHeads(config, "fixed").double()
    by_level = heads(_matched(views=2, batch=2))
    assert [len(items) for items in by_level] == [2, 2, 2]
    for level, items in zip((3, 2, 1), by_level, strict=True):
        for gaussians in items:
            assert gaussians.levels.unique().tolist() == [level]
            assert len(gaussians) == 2 * lattice_size(64)
            assert float(gaussians.opacities.min()) > 0.5 and float(gaussians.opacities.max()) < 0.74
    sum(items[0].scales.sum() for items in by_level).backward()
    assert all(parameter.grad is not None for parameter in heads.levels.parameters())


@pytest.mark.shared
def test_auxiliary_heads_have_the_shapes_of_the_official_ones(recipe):
    official = recipe("pansplat-512-360loc_aux")
    with torch.device("meta"):
        ours = build_auxiliary_heads(PanSplat(compat="official")).state_dict()
    assert sorted(tuple(t.shape) for t in official.values()) == sorted(tuple(t.shape) for t in ours.values())
