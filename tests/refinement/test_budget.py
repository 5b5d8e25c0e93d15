"""Dropping and merging Gaussians."""

import dataclasses

import pytest
import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.refinement.budget import DROP_ERROR, drop_unseen, measure_contributions, merge_to
from pansplat.rendering import rasterize

SIZE = (32, 64)


def test_contributions_of_a_view_sum_to_its_mean_alpha(room) -> None:
    scene = dataclasses.replace(room.truth, cam2world=room.truth.cam2world[:1])
    only = dataclasses.replace(scene, gaussians=scene.gaussians.select(scene.gaussians.views == 0))
    alpha = rasterize(only.gaussians, only.cam2world[0], size=(16, 32)).alpha  # contributions are of half the size
    area = torch.cos((torch.arange(16) + 0.5) / 16 * torch.pi - torch.pi / 2)[:, None].expand(16, 32)
    expected = float((alpha * area).sum() / area.sum())
    assert float(measure_contributions(only, SIZE).sum()) == pytest.approx(expected, rel=1e-3)


def test_hidden_and_transparent_gaussians_are_dropped_and_the_images_stay(room) -> None:
    scene = room.truth
    opacities = scene.gaussians.opacities.clone()
    opacities[:50] = 1e-4
    scene = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, opacities=opacities))
    kept = drop_unseen(scene, SIZE).gaussians
    assert len(kept) <= len(scene.gaussians) - 50
    for pose in (*scene.cam2world, scene.pose_between(0.5)):
        before, after = (
            rasterize(g.select(g.views == 0), pose, size=SIZE).color.clamp(0, 1) for g in (scene.gaussians, kept)
        )
        assert float((before - after).abs().mean()) <= DROP_ERROR


def test_merging_keeps_mass_centre_and_covariance_of_a_pair(room) -> None:
    pair = room.truth.gaussians.select(torch.tensor([10, 11]))
    pair = dataclasses.replace(pair, means=torch.tensor([[1.0, 0, 2], [1.2, 0, 2]]), opacities=torch.tensor([0.4, 0.4]))
    scene = dataclasses.replace(room.truth, gaussians=pair, cam2world=room.truth.cam2world[:1])
    merged = merge_to(scene, SIZE, 1).gaussians
    assert len(merged) == 1
    torch.testing.assert_close(merged.means, torch.tensor([[1.1, 0, 2]]))
    expected = pair.covariances.mean(0)
    expected[0, 0] += 0.01
    torch.testing.assert_close(merged.covariances[0], expected, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(merged.harmonics[0], pair.harmonics.mean(0))


def test_a_budget_is_kept_and_views_and_levels_are_not_mixed(room) -> None:
    scene = room.predicted
    levels = (torch.arange(len(scene.gaussians)) % 2).long()
    scene = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, levels=levels))
    for count in (900, 300, 7):
        small = merge_to(scene, SIZE, count).gaussians
        assert 0 < len(small) <= count
        assert torch.isfinite(small.covariances).all() and float(small.opacities.max()) < 0.9901
    half = merge_to(scene, SIZE, 600).gaussians
    assert {(int(a), int(b)) for a, b in zip(half.views, half.levels, strict=True)} == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_merging_equal_neighbours_changes_the_image_less_than_dropping_them(room) -> None:
    scene = room.truth
    smooth = 0.5 * scene.gaussians.means[:, None, :] / 3  # colours vary slowly
    scene = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, harmonics=smooth))
    contributions = measure_contributions(scene, SIZE)
    merged = merge_to(scene, SIZE, 800).gaussians
    best = contributions.argsort(descending=True, stable=True)[:800]
    pose = scene.pose_between(0.5)

    def image(gaussians: Gaussians) -> torch.Tensor:
        return rasterize(gaussians.select(gaussians.views == 0), pose, size=SIZE).color

    truth = image(scene.gaussians)
    merge_error, drop_error = (
        float((image(g) - truth).abs().mean()) for g in (merged, scene.gaussians.select(best.sort().values))
    )
    assert merge_error < 0.5 * drop_error


def test_uniform_surfaces_are_merged_again_before_detail_is_merged(room) -> None:
    scene = room.truth
    is_left = scene.gaussians.means[:, 0] < 0
    colors = torch.rand(len(is_left), 1, 3, generator=torch.Generator().manual_seed(0)) * is_left[:, None, None]
    scene = dataclasses.replace(scene, gaussians=dataclasses.replace(scene.gaussians, harmonics=colors))
    detail = int(is_left.sum())
    merged = merge_to(scene, SIZE, round(0.65 * len(is_left))).gaussians
    assert int((merged.means[:, 0] < 0).sum()) > 0.85 * detail
