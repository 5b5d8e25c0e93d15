"""Parameters of a refinement: the Gaussians of a view, gains and pose corrections."""

import math

import torch

from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.pose import orthonormal_error
from pansplat.refinement.parameters import CameraParameters, ViewParameters
from pansplat.rendering import rasterize


def _view(room, view: int = 0) -> tuple[Gaussians, torch.Tensor]:
    gaussians = room.predicted.gaussians
    return gaussians.select(gaussians.views == view), room.predicted.cam2world[view, :3, 3]


def test_building_at_the_start_returns_the_given_gaussians(room) -> None:
    given, camera = _view(room)
    built = ViewParameters(given, camera).build()
    for name in ("means", "scales", "quats", "opacities", "harmonics"):
        torch.testing.assert_close(getattr(built, name), getattr(given, name), rtol=1e-5, atol=1e-6)
    assert torch.equal(built.levels, given.levels) and torch.equal(built.views, given.views)


def test_a_change_of_distance_keeps_direction_and_angular_size(room) -> None:
    given, camera = _view(room)
    parameters = ViewParameters(given, camera)
    with torch.no_grad():
        parameters.tensors["distance"].fill_(math.log(1.5))
    built = parameters.build()
    torch.testing.assert_close(built.means - camera.float(), 1.5 * (given.means - camera.float()), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(built.scales, 1.5 * given.scales)


def test_harmonics_of_higher_degree_are_kept(room) -> None:
    given, camera = _view(room)
    harmonics = torch.randn(len(given), 4, 3, generator=torch.Generator().manual_seed(0))
    given = Gaussians(*(harmonics if name == "harmonics" else value for name, value in vars(given).items()))
    torch.testing.assert_close(ViewParameters(given, camera).build().harmonics, harmonics)


def test_halves_keep_the_mean_of_a_gaussian_and_the_variance_across_its_longest_axis(room) -> None:
    given, camera = _view(room)
    random = torch.Generator().manual_seed(0)
    given.scales.mul_(1 + torch.rand(given.scales.shape, generator=random))
    given.quats[:] = torch.randn(given.quats.shape, generator=random)
    is_split = torch.rand(len(given), generator=random) < 0.3
    parameters = ViewParameters(given, camera)
    with torch.no_grad():
        parameters.tensors["distance"].fill_(0.2)
    before = parameters.build()
    parameters.split(is_split)
    after = parameters.build()
    counts = 1 + is_split.long()
    kept = after.select(~is_split.repeat_interleave(counts))
    for name, value in vars(before.select(~is_split)).items():
        torch.testing.assert_close(getattr(kept, name), value)
    first, second = (after.select(is_split.repeat_interleave(counts).nonzero()[half::2, 0]) for half in (0, 1))
    torch.testing.assert_close((first.means + second.means) / 2, before.means[is_split], rtol=1e-5, atol=1e-5)
    shift = (first.means - second.means) / 2
    together = first.covariances + shift[:, :, None] * shift[:, None, :]
    ratio = torch.linalg.eigvals(together @ before.covariances[is_split].inverse()).real.sort(dim=1).values
    torch.testing.assert_close(ratio, torch.tensor([0.74, 1.0, 1.0]).expand_as(ratio), rtol=1e-3, atol=1e-3)
    assert all(tensor.requires_grad and tensor.is_leaf for tensor in parameters.tensors.values())


def test_gaussians_at_the_camera_and_of_extreme_opacity_stay_finite(room) -> None:
    given, camera = _view(room)
    given.means[0] = camera.float()
    given.opacities[1], given.opacities[2] = 0.0, 1.0
    built = ViewParameters(given, camera).build()
    assert all(torch.isfinite(value).all() for value in vars(built).values() if value.is_floating_point())


def test_moving_the_gaussians_equals_moving_the_camera_in_their_frame(room) -> None:
    cameras = CameraParameters(room.predicted.cam2world, correct_poses=True)
    with torch.no_grad():
        cameras.twists.copy_(0.02 * torch.randn(2, 6, generator=torch.Generator().manual_seed(1)))
    given, _ = _view(room)
    size = (32, 64)
    in_frame = rasterize(given, cameras.pose_in_view(0, 1).detach(), size=size).color
    in_world = rasterize(cameras.move(given, 0), cameras.corrected_pose(1), size=size).color
    torch.testing.assert_close(in_frame, in_world, atol=2e-4, rtol=1e-3)
    assert orthonormal_error(cameras.corrected_pose(1)) < 1e-12
