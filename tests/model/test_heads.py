"""Gaussian heads: tiled equals untiled, turning and rolling, switches, gradients, the original's numbers."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.harmonics import rotate_harmonics
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.fibonacci import lattice_size
from pansplat.geometry.pose import rotations_from_quats
from pansplat.model.cost_volume import Depths, LevelDepth
from pansplat.model.heads import AUXILIARY_HEADS, AdapterConfig, AuxiliaryHeads, GaussianHeads, HeadsConfig
from pansplat.model.weights import official_names

SMALL = HeadsConfig(feature_channels=(6, 5, 4, 3), candidates=4, adapter=AdapterConfig(degree=1))
_FIELDS = ("means", "scales", "quats", "opacities", "harmonics")


def _heads(config: HeadsConfig = SMALL, compat="fixed") -> GaussianHeads:
    torch.manual_seed(0)
    return GaussianHeads(config, compat).double()


def _inputs(height: int = 64, views: int = 2, batch: int = 1) -> tuple:
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
    return random(3, height, 2 * height).sigmoid(), features, Depths(tuple(sweeps)), poses, near, far


def _rolled(inputs: tuple, columns_at_coarsest: int) -> tuple:
    def roll(maps: torch.Tensor) -> torch.Tensor:
        return maps.roll(columns_at_coarsest * (maps.shape[-1] // (inputs[1][0].shape[-1])), dims=-1)

    images, features, depths, *rest = inputs
    sweeps = [
        dataclasses.replace(
            sweep,
            **{name: roll(getattr(sweep, name)) for name in ("inverse_depth", "confidence", "logits", "candidates")},
        )
        for sweep in depths.levels
    ]
    return roll(images), [roll(maps) for maps in features], Depths(tuple(sweeps)), *rest


def _difference(a: Gaussians, b: Gaussians) -> float:
    assert torch.equal(a.levels, b.levels) and torch.equal(a.views, b.views)
    return max(float((getattr(a, name) - getattr(b, name)).detach().abs().max()) for name in _FIELDS)


@pytest.mark.parametrize(("lattice", "tiles"), [("fibonacci", 2), ("pixel", 4), ("fibonacci", 8)])
def test_tiled_heads_equal_untiled(lattice, tiles):
    heads, inputs = _heads(dataclasses.replace(SMALL, lattice=lattice)), _inputs()
    with torch.no_grad():
        assert _difference(heads(*inputs)[0], heads(*inputs, tiles=tiles)[0]) < 1e-12


def test_tiled_heads_equal_untiled_in_float32():
    heads = _heads().float()
    images, features, depths, *rest = _inputs()
    sweeps = tuple(
        LevelDepth(s.level, *(getattr(s, f.name).float() for f in dataclasses.fields(s)[1:])) for s in depths.levels
    )
    inputs = (images.float(), [f.float() for f in features], Depths(sweeps), *(tensor.float() for tensor in rest))
    with torch.no_grad():
        assert _difference(heads(*inputs)[0], heads(*inputs, tiles=4)[0]) < 1e-5


def test_the_originals_tiles_change_its_output():
    heads, inputs = _heads(compat="official"), _inputs()
    with torch.no_grad():
        whole = heads(*inputs)[0]
        parts = list(heads.iterate_tiles(*inputs, tiles=2))
        tiled = Gaussians.cat([part.gaussians[0] for part in parts])
        assert _difference(heads(*inputs, tiles=2)[0], tiled) == 0  # tile by tile, as it orders them
        index = torch.cat([part.index for part in parts])
        assert _difference(whole, tiled.select(torch.argsort(index))) > 1e-3


def test_one_tile_made_again_is_the_same_with_gradients():
    heads, inputs = _heads(), _inputs()
    with torch.no_grad():
        whole = heads(*inputs)[0]
    weights = torch.randn(whole.means.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    (heads(*inputs)[0].means * weights).sum().backward()
    expected = [parameter.grad.clone() for parameter in heads.parameters()]
    heads.zero_grad()
    for number in range(4):
        (part,) = heads.iterate_tiles(*inputs, tiles=2, only=[number])
        assert _difference(part.gaussians[0], whole.select(part.index)) < 1e-12
        (part.gaussians[0].means * weights[part.index]).sum().backward()
    for parameter, gradient in zip(heads.parameters(), expected, strict=True):
        assert torch.allclose(parameter.grad, gradient, atol=1e-10)


def test_tiles_hold_every_gaussian_once():
    heads, inputs = _heads(), _inputs(views=3)
    with torch.no_grad():
        index = torch.cat([part.index for part in heads.iterate_tiles(*inputs, tiles=4)])
    assert torch.equal(index.sort().values, torch.arange(3 * sum(lattice_size(128 >> level) for level in range(4))))


@pytest.mark.parametrize("columns", [1, 8, 13])
def test_rolling_the_panorama_rolls_the_maps(columns):
    """By any number of the coarsest level's pixels, half a turn (8) among them."""
    heads, inputs = _heads(dataclasses.replace(SMALL, lattice="pixel", emitted="finest")), _inputs(views=1)
    with torch.no_grad():
        before, after = heads(*inputs)[0], heads(*_rolled(inputs, columns))[0]
    for name in ("opacities", "scales"):
        maps = getattr(before, name).unflatten(0, (64, 128)).roll(8 * columns, dims=1)
        assert torch.allclose(getattr(after, name), maps.flatten(0, 1), atol=1e-12)
    maps = (before.means - inputs[3][0, 0, :3, 3]).norm(dim=-1).unflatten(0, (64, 128)).roll(8 * columns, dims=1)
    assert torch.allclose((after.means - inputs[3][0, 0, :3, 3]).norm(dim=-1), maps.flatten(), atol=1e-12)


def test_rolling_the_panorama_breaks_the_original():
    heads = _heads(dataclasses.replace(SMALL, lattice="pixel", emitted="finest"), "official")
    inputs = _inputs(views=1)
    with torch.no_grad():
        before, after = heads(*inputs)[0], heads(*_rolled(inputs, 8))[0]
    maps = before.opacities.unflatten(0, (64, 128)).roll(64, dims=1).flatten()
    assert float((after.opacities - maps).abs().max()) > 1e-3


def test_turning_the_world_turns_the_gaussians():
    heads, (images, features, depths, poses, near, far) = _heads(), _inputs()
    world = torch.eye(4, dtype=torch.float64)
    world[:3, :3] = rotations_from_quats(torch.tensor((0.3, -0.5, 0.7, 0.2), dtype=torch.float64))
    world[:3, 3] = torch.tensor((1.0, -2.0, 3.0))
    with torch.no_grad():
        before = heads(images, features, depths, poses, near, far)[0]
        after = heads(images, features, depths, world @ poses, near, far)[0]
    rotation = world[:3, :3]
    assert torch.allclose(after.means, before.means @ rotation.T + world[:3, 3], atol=1e-11)
    assert torch.allclose(after.covariances, rotation @ before.covariances @ rotation.T, atol=1e-11)
    assert torch.allclose(after.harmonics, rotate_harmonics(before.harmonics, rotation), atol=1e-11)


@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_order_is_level_coarse_to_fine_then_view_then_point(compat):
    with torch.no_grad():
        gaussians = _heads(compat=compat)(*_inputs(views=3))[0]
    expected = [(level, view) for level in (3, 2, 1, 0) for view in range(3) for _ in range(lattice_size(128 >> level))]
    assert list(zip(gaussians.levels.tolist(), gaussians.views.tolist(), strict=True)) == expected


def test_views_and_batch_items_are_lifted_by_themselves():
    heads, (images, features, depths, poses, near, far) = _heads(), _inputs(views=2, batch=2)
    with torch.no_grad():
        whole = heads(images, features, depths, poses, near, far)
        sweeps = tuple(
            LevelDepth(s.level, *(getattr(s, f.name)[1:, 1:] for f in dataclasses.fields(s)[1:])) for s in depths.levels
        )
        cut = [features[i][1:, 1:] for i in range(4)]
        alone = heads(images[1:, 1:], cut, Depths(sweeps), poses[1:, 1:], near[1:, 1:], far[1:, 1:])[0]
    second = whole[1].select(whole[1].views == 1)
    assert all(torch.equal(getattr(second, name), getattr(alone, name)) for name in _FIELDS)


@pytest.mark.parametrize("height", [80, 128])
def test_heads_run_at_other_heights(height):
    with torch.no_grad():
        gaussians = _heads()(*_inputs(height, views=1), tiles=2)[0]
    assert len(gaussians) == sum(lattice_size(2 * height >> level) for level in range(4))
    assert bool(torch.isfinite(gaussians.means).all())


@pytest.mark.parametrize("compat", ["official", "fixed"])
def test_gradients_reach_every_weight_and_input(compat):
    heads, (images, features, depths, *rest) = _heads(compat=compat), _inputs(views=1)
    features = [maps.requires_grad_() for maps in features]
    logits = depths.logits.requires_grad_()
    gaussians = heads(images.requires_grad_(), features, depths, *rest)[0]
    torch.stack([(getattr(gaussians, name) ** 2).sum() for name in _FIELDS]).sum().backward()
    for tensor in (images, *features, logits, *heads.parameters()):
        assert tensor.grad is not None and float(tensor.grad.abs().max()) > 0
        assert bool(torch.isfinite(tensor.grad).all())


def test_depth_stays_within_its_bounds():
    inputs = _inputs()
    near, far = inputs[4] * 3, inputs[4] * 4  # the candidates lie beyond, both ways
    with torch.no_grad():
        gaussians = _heads()(*inputs[:4], near, far)[0]
    origins = inputs[3][0, gaussians.views.long(), :3, 3]
    depths = (gaussians.means - origins).norm(dim=-1)
    assert float(depths.min()) >= 1.5 - 1e-9 and float(depths.max()) <= 2 + 1e-9


def test_bfloat16_convolutions_change_little():
    """float32 is the truth; 2^-8 relative a value, through 12 layers."""
    heads = _heads().float()
    images, features, depths, *rest = _inputs(views=1)
    sweeps = tuple(
        LevelDepth(s.level, *(getattr(s, f.name).float() for f in dataclasses.fields(s)[1:])) for s in depths.levels
    )
    inputs = (images.float(), [f.float() for f in features], Depths(sweeps), *(tensor.float() for tensor in rest))
    with torch.no_grad():
        exact = heads(*inputs)[0]
        heads.precision = "bfloat16"
        rough = heads(*inputs)[0]
    assert rough.means.dtype == torch.float32
    assert 0 < float((exact.opacities - rough.opacities).abs().max()) < 0.01


class TestSwitches:
    """Each ablation of the paper runs, and does what its name says."""

    def _run(self, **switches: object) -> tuple[GaussianHeads, Gaussians]:
        heads = _heads(dataclasses.replace(SMALL, **switches))
        with torch.no_grad():
            return heads, heads(*_inputs())[0]

    def test_pixel_lattice_has_a_gaussian_a_pixel_and_no_linear_layer(self):
        heads, gaussians = self._run(lattice="pixel")
        assert len(gaussians) == 2 * sum((64 >> level) * (128 >> level) for level in range(4))
        assert not any("linear" in name for name, _ in heads.named_parameters())

    def test_a_single_level_has_the_finest_head_only(self):
        heads, gaussians = self._run(levels="single")
        assert len(heads.levels) == 1 and gaussians.levels.unique().tolist() == [0]
        assert len(gaussians) == 2 * lattice_size(128)

    def test_coarse_heads_may_serve_the_finest_only(self):
        heads, gaussians = self._run(emitted="finest")
        _, every = self._run()
        assert len(heads.levels) == 4
        assert _difference(gaussians, every.select(every.levels == 0)) == 0

    def test_without_residual_no_level_reads_another(self):
        heads, gaussians = self._run(residual=False)
        assert [head.convs[0].in_channels for head in heads.levels] == [13, 12, 11, 10]
        heads.levels[0].convs[0].weight.data.zero_()
        with torch.no_grad():
            changed = heads(*_inputs())[0]
        fine, changed_fine = (g.select(g.levels < 3) for g in (gaussians, changed))
        assert _difference(fine, changed_fine) == 0

    def test_swept_depth_is_the_cost_volumes(self):
        heads, gaussians = self._run(depth="swept", lattice="pixel")
        inputs = _inputs()
        level = gaussians.select((gaussians.levels == 1) & (gaussians.views == 1))
        depths = (level.means - inputs[3][0, 1, :3, 3]).norm(dim=-1)
        assert torch.allclose(1 / depths, inputs[2].inverse_depth[-1][0, 1].flatten())
        assert torch.allclose(level.opacities, inputs[2].confidence[-1][0, 1].flatten().sigmoid())
        assert heads.config.outputs == 2 + 7 + 12


def test_sizes_that_do_not_divide_are_refused():
    with pytest.raises(InputError, match="4x4 tiles on 4 levels need a height that 32 divides, got 80"):
        _heads()(*_inputs(80), tiles=4)
    with pytest.raises(InputError, match="at least 56 pixels high, got 48"):
        _heads()(*_inputs(48))


def test_auxiliary_heads_make_a_set_a_swept_level():
    torch.manual_seed(0)
    config = dataclasses.replace(AUXILIARY_HEADS, feature_channels=(6, 5, 4), candidates=4, adapter=SMALL.adapter)
    heads = AuxiliaryHeads(config, "fixed").double()
    inputs = _inputs(views=2, batch=2)
    by_level = heads(*inputs)
    assert [len(items) for items in by_level] == [2, 2, 2]
    for level, items in zip((3, 2, 1), by_level, strict=True):
        for gaussians in items:
            assert gaussians.levels.unique().tolist() == [level]
            assert len(gaussians) == 2 * lattice_size(64)
            assert float(gaussians.opacities.min()) > 0.5 and float(gaussians.opacities.max()) < 0.74
    sum(items[0].scales.sum() for items in by_level).backward()
    assert all(parameter.grad is not None for parameter in heads.levels.parameters())


@pytest.mark.shared
def test_auxiliary_heads_have_the_originals_tensors(recipe: Callable[[str], dict[str, torch.Tensor]]):
    official = recipe("pansplat-512-360loc_aux")
    ours = AuxiliaryHeads(AUXILIARY_HEADS, "official").state_dict()
    assert sorted(tuple(t.shape) for t in official.values()) == sorted(tuple(t.shape) for t in ours.values())


@pytest.mark.shared
def test_heads_compute_what_the_original_does(
    recipe_weights: dict[str, torch.Tensor], golden: Callable[[str], dict[str, torch.Tensor]]
):
    """From the original's own features and depths; largest difference in standard deviations (1e-3 would do)."""
    fixture = golden("pansplat_64x128_fp32attn")
    heads = GaussianHeads(HeadsConfig(), "official")
    names = {theirs: ours for theirs, ours in official_names("pansplat").items() if ours.startswith("heads.")}
    heads.load_state_dict({ours[6:]: recipe_weights[theirs] for theirs, ours in names.items()})
    finest = LevelDepth(
        1, fixture["s2.disp"], fixture["s2.pdf_max"].transpose(0, 1), fixture["s2.logits"], fixture["s2.candidates"]
    )
    features = [fixture[f"backbone.feat.{stage}"] for stage in range(4)]
    with torch.no_grad():
        gaussians = heads(
            fixture["in.image"], features, Depths((finest,)), fixture["in.extrinsics"], fixture["in.near"],
            fixture["in.far"],
        )[0]  # fmt: skip
    y_z_x = torch.tensor(((0.0, 0, 1), (1, 0, 0), (0, 1, 0)))
    for stage in range(4):
        for view in range(2):
            part = gaussians.select((gaussians.levels == 3 - stage) & (gaussians.views == view))
            found = {name: getattr(part, name) for name in ("means", "covariances", "opacities", "scales")}
            found["harmonics"] = rotate_harmonics(part.harmonics, y_z_x).transpose(1, 2)
            camera = fixture["in.extrinsics"][0, view, :3, :3]
            found["rotations"] = camera.T @ rotations_from_quats(part.quats)
            for name, tensor in found.items():
                expected = fixture[f"g.s{stage}.v{view}.{name}"]
                if name == "rotations":
                    expected = rotations_from_quats(expected.roll(1, dims=-1))
                error = float((tensor - expected).abs().max() / expected.std())
                assert error < 2e-4, (stage, view, name, error)
