"""A network as a predictor: what it refuses, masks, batches, tiles, streams, its fingerprint."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import uv_from_directions
from pansplat.geometry.fibonacci import lattice_size
from pansplat.model.cost_volume import CostVolumeConfig, SweepLevel
from pansplat.model.feature_pyramid import FeaturePyramidConfig, TransformerConfig
from pansplat.model.heads import AdapterConfig, HeadsConfig
from pansplat.model.network import NetworkPredictor, choose_tiles
from pansplat.model.pansplat import PanSplat, PanSplatConfig
from pansplat.predictor import Predictor

SMALL = PanSplatConfig(
    features=FeaturePyramidConfig(channels=(4, 8, 8, 16), transformer=TransformerConfig(channels=16, blocks=1)),
    cost_volume=CostVolumeConfig(
        mono_channels=0,
        levels=(SweepLevel(3, 16, 8, 32), SweepLevel(2, 8, 4, 32), SweepLevel(1, 8, 4, 32)),
    ),
    heads=HeadsConfig(feature_channels=(16, 8, 8, 4), candidates=4, adapter=AdapterConfig(degree=1)),
)
_PER_VIEW = sum(lattice_size(128 >> level) for level in range(4))


def _predictor(compat="fixed", tiles: int | None = None, seed: int = 0) -> NetworkPredictor:
    torch.manual_seed(seed)
    return NetworkPredictor("small", PanSplat(SMALL, compat), tiles=tiles)


def _inputs(height: int = 64, views: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    poses = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    poses[:, :3, 3] = 0.3 * torch.randn(views, 3, generator=generator, dtype=torch.float64)
    return torch.rand(views, 3, height, 2 * height, generator=generator), poses


def test_it_is_a_predictor():
    assert isinstance(_predictor(), Predictor)


def test_a_batch_gives_a_list_of_what_its_items_give():
    predictor, (images, poses) = _predictor(), _inputs()
    alone = predictor(images, poses, 0.5, 20.0)
    assert isinstance(alone, Gaussians) and len(alone) == 2 * _PER_VIEW
    both = predictor(torch.stack((images.flip(0), images)), torch.stack((poses, poses)), torch.tensor((1.0, 0.5)), 20.0)
    assert isinstance(both, list) and len(both) == 2
    assert torch.equal(both[1].means, alone.means)
    assert not torch.equal(both[0].means, alone.means)


def test_masked_pixels_make_no_gaussians_and_leave_the_others():
    predictor, (images, poses) = _predictor(), _inputs()
    masks = torch.ones(2, 64, 128, dtype=torch.bool)
    masks[1, 40:] = False
    every, kept = predictor(images, poses, 0.5, 20.0), predictor(images, poses, 0.5, 20.0, masks=masks)
    assert int((kept.views == 0).sum()) == _PER_VIEW
    assert 0.3 * _PER_VIEW < int((kept.views == 1).sum()) < 0.8 * _PER_VIEW
    local = kept.means[kept.views == 1] - poses[1, :3, 3].float()
    assert float(uv_from_directions(local)[:, 1].max()) * 64 < 40.01
    first, second = (g.select(g.views == 0) for g in (every, kept))
    assert torch.equal(first.means, second.means)
    assert len(predictor(images, poses, 0.5, 20.0, masks=~torch.ones_like(masks))) == 0


def test_depths_come_with_the_gaussians_when_asked_for():
    predictor, (images, poses) = _predictor(), _inputs()
    gaussians, depths = predictor.predict_with_depths(images, poses, 0.5, 20.0)
    assert torch.equal(gaussians.means, predictor(images, poses, 0.5, 20.0).means)
    assert [tuple(depth.shape) for depth in depths] == [(2, 8, 16), (2, 16, 32), (2, 32, 64)]
    assert all(float(depth.min()) >= 0.5 - 1e-6 and float(depth.max()) <= 20 + 1e-4 for depth in depths)


def test_a_stream_gives_the_same_gaussians_tile_by_tile():
    predictor, (images, poses) = _predictor(tiles=2), _inputs()
    masks = torch.ones(2, 64, 128, dtype=torch.bool)
    masks[0, :20] = False
    whole = predictor(images, poses, 0.5, 20.0, masks=masks)
    parts = list(predictor.stream(images, poses, 0.5, 20.0, masks=masks))
    assert len(parts) == 4 and all(len(part) > 0 for part in parts)
    streamed = Gaussians.cat(parts)
    assert len(streamed) == len(whole)
    for name in ("means", "opacities"):
        a, b = (getattr(g, name).reshape(len(g), -1).sort(dim=0).values for g in (whole, streamed))
        assert torch.equal(a, b)


def test_no_gradient_is_kept():
    predictor, (images, poses) = _predictor(), _inputs()
    assert not predictor(images.requires_grad_(), poses, 0.5, 20.0).means.requires_grad
    assert not next(predictor.stream(images, poses, 0.5, 20.0)).means.requires_grad
    assert torch.is_grad_enabled()


def test_progress_rises_to_one():
    predictor, (images, poses) = _predictor(tiles=2), _inputs()
    told: list[tuple[str, float]] = []
    predictor(images, poses, 0.5, 20.0, progress=lambda what, fraction: told.append((what, fraction)))
    fractions = [fraction for _, fraction in told]
    assert fractions == sorted(fractions) and fractions[0] == 0 and told[-1] == ("done", 1.0)
    assert {what for what, _ in told} == {"matching views", "making Gaussians", "done"}


def test_tiles_follow_the_height():
    assert [choose_tiles(height) for height in (256, 512, 1024, 2048)] == [1, 1, 2, 4]


def test_the_fingerprint_tells_weights_settings_and_compatibility_apart():
    fingerprints = {
        _predictor().fingerprint,
        _predictor(seed=1).fingerprint,
        _predictor("official").fingerprint,
        NetworkPredictor(
            "small", PanSplat(dataclasses.replace(SMALL, heads=dataclasses.replace(SMALL.heads, residual=False)))
        ).fingerprint,
    }
    assert len(fingerprints) == 4
    assert _predictor().fingerprint == _predictor().fingerprint


@pytest.mark.usefixtures("unchecked")
class TestRefusals:
    """What is wrong, what was needed, and what to do."""

    def _refused(self, match: str, images: torch.Tensor, poses: torch.Tensor, near=0.5, far=20.0, **options) -> None:
        compat = options.pop("compat", "fixed")
        with pytest.raises(InputError, match=match):
            _predictor(compat)(images, poses, near, far, **options)

    def test_shapes(self):
        images, poses = _inputs()
        self._refused(r"must be \(view, 3, height, 2 \* height\), got \(2, 3, 64, 64\)", images[..., :64], poses)
        self._refused(r"`cam2world` must be \(2, 4, 4\) to fit the images, got \(1, 4, 4\)", images, poses[:1])
        masks = torch.ones(2, 32, 64, dtype=torch.bool)
        self._refused(r"`masks` must be \(2, 64, 128\)", images, poses, masks=masks)

    def test_sizes(self):
        self._refused("a multiple of 32, got 80; resize", *_inputs(80))
        self._refused("a multiple of 16, got 72; resize", *_inputs(72), compat="official")
        self._refused("at least 64 pixels high", *_inputs(32))

    def test_view_counts(self):
        self._refused("two or more views, got 1", *_inputs(views=1))
        self._refused("exactly two views", *_inputs(views=3), compat="official")

    def test_values(self):
        images, poses = _inputs()
        broken = images.clone()
        broken[0, 0, 0, 0] = float("nan")
        self._refused("must be finite, got NaN", broken, poses)
        self._refused("0 < near < far", images, poses, near=3.0, far=2.0)
        self._refused("0 < near < far", images, poses, near=0.0)
        self._refused("one number, or one a view", images, poses, near=torch.ones(3))
