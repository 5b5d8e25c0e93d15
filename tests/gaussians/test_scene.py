"""The set of Gaussians: checked shapes, covariances, selection, joining, pruning."""

import dataclasses

import pytest
import torch

from pansplat.gaussians.harmonics import evaluate_harmonics
from pansplat.gaussians.scene import Gaussians, Scene, prune
from pansplat.geometry.pose import rotations_from_quats


def test_covariances_have_the_squared_scales_as_eigenvalues(make_scene):
    gaussians = make_scene(20).gaussians.to(dtype=torch.float64)
    eigenvalues = torch.linalg.eigvalsh(gaussians.covariances)
    assert torch.allclose(eigenvalues, (gaussians.scales**2).sort(dim=1).values)


def test_wrong_shapes_are_refused_with_the_name(unchecked, make_scene):
    good = make_scene(3).gaussians
    fields = {name: getattr(good, name) for name in good.__dataclass_fields__}
    with pytest.raises(ValueError, match=r"`scales` must have shape \(3, 3\).*got \(2, 3\)"):
        Gaussians(**{**fields, "scales": good.scales[:2]})
    with pytest.raises(ValueError, match="`harmonics`"):
        Gaussians(**{**fields, "harmonics": torch.zeros(3, 5, 3)})


def test_joining_appends_sets_of_one_degree(make_scene):
    a, b = make_scene(3).gaussians, make_scene(4, seed=1).gaussians
    joined = Gaussians.cat([a, b])
    assert len(joined) == 7 and torch.equal(joined.quats[3:], b.quats)
    with pytest.raises(ValueError, match=r"one SH degree, got \[0, 1\]"):
        Gaussians.cat([a, make_scene(2, 0).gaussians])
    with pytest.raises(ValueError, match="at least one"):
        Gaussians.cat([])


@pytest.fixture
def translucent(make_scene) -> Gaussians:
    """Degree 4, with opacities in increasing order."""
    return dataclasses.replace(make_scene(50, 4).gaussians, opacities=torch.linspace(0, 1, 50))


def test_pruning_keeps_the_opaque_gaussians(translucent):
    kept = prune(translucent, min_opacity=float(translucent.opacities[20]))
    assert torch.equal(kept.opacities, translucent.opacities[20:])
    assert torch.equal(kept.harmonics, translucent.harmonics[20:])


def test_pruning_to_a_degree_keeps_the_lower_coefficients(translucent):
    for degree in range(4):
        kept = prune(translucent, degree=degree)
        assert kept.degree == degree and len(kept) == len(translucent)
        assert torch.equal(kept.harmonics, translucent.harmonics[:, : (degree + 1) ** 2])
        assert torch.equal(kept.means, translucent.means)
    assert prune(prune(translucent, degree=1), degree=3).degree == 1


def test_pose_between_starts_and_ends_at_the_cameras(make_scene):
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[1, :3, 3] = torch.tensor((1 / 3, -2e-7, 12345.678901234567))
    scene = Scene(make_scene(2).gaussians, poses, near=0.5, far=8.0)
    assert torch.allclose(scene.pose_between(0.0), poses[0]) and torch.allclose(scene.pose_between(1.0), poses[1])
    assert torch.allclose(scene.pose_between(0.5)[:3, 3], poses[:, :3, 3].mean(dim=0))


def test_a_rotation_turns_shapes_and_colours_with_the_world(make_scene):
    gaussians = make_scene(5, 2).gaussians.to(dtype=torch.float64)
    turn = rotations_from_quats(torch.tensor([0.5, -0.1, 0.7, 0.3], dtype=torch.float64))
    poses = torch.eye(4, dtype=torch.float64)[None]
    turned = Scene(gaussians, poses, 0.1, 10.0).rotated(turn)
    assert torch.allclose(turned.gaussians.covariances, turn @ gaussians.covariances @ turn.T)
    directions = torch.nn.functional.normalize(gaussians.means, dim=1)
    seen = evaluate_harmonics(turned.gaussians.harmonics, directions @ turn.T)
    assert torch.allclose(seen, evaluate_harmonics(gaussians.harmonics, directions))
    assert torch.allclose(turned.gaussians.means, gaussians.means @ turn.T)
    assert torch.allclose(turned.cam2world[0, :3, :3], turn)
