"""Smooth gains of photographs of one surface."""

import dataclasses

import torch
from synthetic_scenes import make_balls

from pansplat.gaussians.harmonics import SH_0
from pansplat.geometry.equirect import pixel_directions, row_weights, sample_equirect, uv_from_directions
from pansplat.rendering.gains import equalize_gaussians, equalize_images, estimate_gains

HEIGHT, RADIUS = 64, 3.0


def make_views(exposure: float, occluder: bool = False):
    """Photographs of a grey sphere from two places inside, the second one under a smooth field of exposure."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, 0, 3] = 0.8
    rays = pixel_directions(HEIGHT, 2 * HEIGHT, dtype=torch.float64)
    along = rays @ poses[:, :3, 3].T
    depths = (-along + (along.square() + RADIUS**2 - poses[:, :3, 3].square().sum(1)).sqrt()).permute(2, 0, 1).float()
    fields = torch.stack((torch.zeros(HEIGHT, 2 * HEIGHT), exposure * rays[..., 0].float() - 0.1))[:, None]
    images = 0.4 * fields.exp().expand(-1, 3, -1, -1)
    masks = torch.ones(2, HEIGHT, 2 * HEIGHT, dtype=torch.bool)
    if occluder:  # a box of another colour in the second photograph only, whose depth does not agree
        images, depths = images.clone(), depths.clone()
        images[1, :, 20:40, 30:60], depths[1, 20:40, 30:60] = 0.9, 1.0
    return images, depths, poses, masks


def test_a_smooth_field_of_exposure_is_recovered_and_each_photograph_gets_the_root_of_it() -> None:
    images, depths, poses, masks = make_views(0.25)
    gains = estimate_gains(images, depths, poses, masks)
    equal = equalize_images(images, gains).log()
    assert (images.log().amax() - images.log().amin()) > 0.4
    rays = pixel_directions(HEIGHT, 2 * HEIGHT)
    points = rays * depths[0, ..., None] - torch.tensor([0.8, 0.0, 0.0])
    seen = sample_equirect(equal[1], uv_from_directions(points))
    area = row_weights(HEIGHT)[:, None].float()
    assert ((seen - equal[0]).abs() * area).mean() < 0.015
    means = (gains * row_weights(gains.shape[-2])[:, None].float()).mean((1, 2, 3))
    assert torch.allclose(means[0], -means[1], atol=0.02)


def test_what_only_one_photograph_shows_does_not_count() -> None:
    plain = estimate_gains(*make_views(0.25))
    occluded = estimate_gains(*make_views(0.25, occluder=True))
    assert (plain - occluded).abs().max() < 0.06  # the logarithms of the two colours differ by 0.8


def test_without_surfaces_that_agree_nothing_changes() -> None:
    images, depths, poses, masks = make_views(0.25)
    gains = estimate_gains(images, 0 * depths, poses, masks)
    assert torch.equal(equalize_images(images, gains), images)


def test_gaussians_are_multiplied_as_the_photograph_of_their_view() -> None:
    images, depths, poses, masks = make_views(0.25)
    gains = estimate_gains(images, depths, poses, masks)
    rays = pixel_directions(HEIGHT, 2 * HEIGHT)[10, ::8]
    one = make_balls(poses[1, :3, 3].float() + 3 * rays, 0.1, 0.9, harmonics=torch.zeros(len(rays), 1, 3))
    one = dataclasses.replace(one, views=torch.ones_like(one.views))
    colors = 0.5 + SH_0 * equalize_gaussians(one, gains, poses).harmonics[:, 0]
    expected = sample_equirect(equalize_images(torch.full_like(images, 0.5), gains)[1], uv_from_directions(rays))
    assert torch.allclose(colors, expected.T, atol=2e-3)
