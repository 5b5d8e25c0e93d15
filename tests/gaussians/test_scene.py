"""The set of Gaussians: checked shapes, covariances, selection, joining, pruning."""

import pytest
import torch

from pansplat.gaussians.scene import Gaussians, prune


def _make(n: int, k: int = 4, seed: int = 0) -> Gaussians:
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=rng),
        scales=torch.rand(n, 3, generator=rng) + 0.1,
        quats=torch.randn(n, 4, generator=rng),
        opacities=torch.rand(n, generator=rng),
        harmonics=torch.randn(n, k, 3, generator=rng),
        levels=torch.arange(n) % 4,
        views=torch.arange(n) % 2,
    )


def test_covariances_have_the_squared_scales_as_eigenvalues():
    gaussians = _make(20).to(dtype=torch.float64)
    eigenvalues = torch.linalg.eigvalsh(gaussians.covariances)
    assert torch.allclose(eigenvalues, (gaussians.scales**2).sort(dim=1).values)


@pytest.mark.parametrize(("k", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3), (25, 4)])
def test_the_degree_follows_from_the_number_of_coefficients(k, degree):
    assert _make(2, k).degree == degree


def test_wrong_shapes_are_refused_by_name(unchecked):
    good = _make(3)
    fields = {name: getattr(good, name) for name in good.__dataclass_fields__}
    with pytest.raises(ValueError, match=r"`scales` must have shape \(3, 3\).*got \(2, 3\)"):
        Gaussians(**{**fields, "scales": good.scales[:2]})
    with pytest.raises(ValueError, match="`harmonics`"):
        Gaussians(**{**fields, "harmonics": torch.zeros(3, 5, 3)})


def test_selecting_keeps_every_field_together():
    gaussians = _make(10)
    chosen = gaussians.select(gaussians.levels == 2)
    assert len(chosen) == 2 and torch.equal(chosen.means, gaussians.means[[2, 6]])
    assert torch.equal(chosen.views, gaussians.views[[2, 6]])


def test_joining_appends_and_needs_one_degree():
    a, b = _make(3), _make(4, seed=1)
    joined = Gaussians.cat([a, b])
    assert len(joined) == 7 and torch.equal(joined.quats[3:], b.quats)
    with pytest.raises(ValueError, match=r"one SH degree, got \[0, 1\]"):
        Gaussians.cat([a, _make(2, 1)])
    with pytest.raises(ValueError, match="at least one"):
        Gaussians.cat([])


def test_changing_the_type_leaves_labels_whole():
    gaussians = _make(3).to(dtype=torch.float64)
    assert gaussians.means.dtype == torch.float64 and gaussians.levels.dtype == torch.int64


def _gaussians() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    count = 50
    return Gaussians(
        means=torch.randn(count, 3, generator=generator),
        scales=torch.rand(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        opacities=torch.linspace(0, 1, count),
        harmonics=torch.randn(count, 25, 3, generator=generator),
        levels=torch.zeros(count, dtype=torch.uint8),
        views=torch.zeros(count, dtype=torch.uint8),
    )


def test_nothing_asked_changes_nothing():
    gaussians = _gaussians()
    assert prune(gaussians) is gaussians
    assert prune(gaussians, degree=4) is gaussians


def test_the_opaque_are_kept_with_all_that_they_have():
    gaussians = _gaussians()
    kept = prune(gaussians, min_opacity=float(gaussians.opacities[20]))
    assert torch.equal(kept.opacities, gaussians.opacities[20:])
    assert torch.equal(kept.harmonics, gaussians.harmonics[20:])


def test_lower_degrees_stay_as_they_are():
    gaussians = _gaussians()
    for degree in range(4):
        kept = prune(gaussians, degree=degree)
        assert kept.degree == degree and len(kept) == len(gaussians)
        assert torch.equal(kept.harmonics, gaussians.harmonics[:, : (degree + 1) ** 2])
        assert torch.equal(kept.means, gaussians.means)
    assert prune(prune(gaussians, degree=1), degree=3).degree == 1
