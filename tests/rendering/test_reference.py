"""The rasteriser against closed forms, a dense float64 renderer, and the laws that pictures obey."""

import dataclasses
import functools
import math

import pytest
import torch

from pansplat.errors import InputError
from pansplat.gaussians.scene import Gaussians
from pansplat.geometry.equirect import pixel_directions
from pansplat.rendering import rasterize as _rasterize

rasterize = functools.partial(_rasterize, backend="torch")  # float32 too

_ORIGIN = torch.eye(4, dtype=torch.float64)


def _ball(mean, sigma=0.1, opacity=0.8, colour=(0.9, 0.4, 0.2), dtype=torch.float64) -> Gaussians:
    harmonics = (torch.tensor([[colour]], dtype=torch.float64) - 0.5) / 0.28209479177387814
    label = torch.zeros(1, dtype=torch.int64)
    mean = torch.as_tensor(mean, dtype=torch.float64)[None]
    scales = torch.full((1, 3), float(sigma), dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    opacities = torch.tensor([opacity], dtype=torch.float64)
    return Gaussians(mean, scales, quats, opacities, harmonics, label, label).to(dtype=dtype)


@pytest.mark.parametrize("mean", [(0, 0, 2.0), (1.0, -0.7, 1.3), (0, -2.0, 0), (-0.1, 0.2, -3.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_ball_has_its_closed_form(mean, dtype):
    height, sigma, opacity = 64, 0.1, 0.8
    ball = _ball(mean, sigma, opacity, dtype=dtype)
    picture = rasterize(ball, _ORIGIN, size=(height, 2 * height), backend="torch")
    mean = torch.tensor(mean, dtype=torch.float64)
    radius = mean.norm()
    cosine = pixel_directions(height, 2 * height, dtype=torch.float64) @ (mean / radius)
    sine2 = 1 - cosine**2
    own, filtered = (sigma / radius) ** 2, (sigma / radius) ** 2 + 0.1 * (math.pi / height) ** 2
    q = sine2 / (filtered * cosine**2 + own * sine2)
    alpha = (opacity * own / filtered) * torch.exp(-q / 2)
    alpha = torch.where((cosine > 0) & (alpha >= 1 / 255), alpha, 0)
    tolerance = 2e-6 if dtype == torch.float32 else 1e-13
    assert picture.alpha.dtype == picture.color.dtype == picture.depth.dtype == dtype
    assert (picture.alpha - alpha).abs().max() < tolerance
    colour = torch.tensor((0.9, 0.4, 0.2), dtype=torch.float64)[:, None, None]
    assert (picture.color - alpha * colour).abs().max() < tolerance
    assert torch.allclose(picture.depth.double(), torch.where(alpha > 0, radius, 0.0), rtol=1e-6)
    assert 0 < float((alpha > 0).double().mean()) < 0.1


_PICTURES = [
    dict(layout="equirect", kernel="ray", order="radial", lowpass="angular"),
    dict(layout="equirect", kernel="ray", order="z", lowpass="3dgs"),
    dict(layout="pinhole", kernel="ray", order="radial", lowpass="3dgs"),
    dict(layout="pinhole", kernel="ray", order="z", lowpass="angular"),
    dict(layout="pinhole", kernel="ewa", order="radial", lowpass="angular"),
    dict(layout="pinhole", kernel="ewa", order="z", lowpass="3dgs"),
]


@pytest.mark.parametrize("options", _PICTURES, ids=lambda o: "-".join(o.values()))
@pytest.mark.parametrize(("count", "scale"), [(60, 0.15), (200, 0.02), (120, 0.5)])
def test_pictures_equal_dense_float64(options, count, scale, make_scene, dense, pose):
    scene = make_scene(count, scale=scale, seed=count)
    size = (22, 44) if options["layout"] == "equirect" else (22, 30)
    fov = None if options["layout"] == "equirect" else 70.0
    order = "radial" if options["layout"] == "equirect" else options["order"]
    literal = {"fov": fov, "kernel": options["kernel"], "order": order, "lowpass": options["lowpass"]}
    color, alpha, depth = dense(scene, pose, size, **literal)
    got = rasterize(scene, pose, size=size, vertical_fov_degrees=70.0, **options)
    assert float(alpha.mean()) > 0.01
    assert (got.color - color).abs().max() < 1e-10
    assert (got.alpha - alpha).abs().max() < 1e-10
    assert (got.depth * got.alpha - depth).abs().max() < 1e-10
    single = rasterize(scene.to(dtype=torch.float32), pose, size=size, vertical_fov_degrees=70.0, **options)
    assert (single.color - color).abs().max() < 1e-5
    assert (single.color - color).abs().mean() < 5e-7


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 3), (3, 5), (8, 8), (9, 17), (31, 62), (33, 70)])
def test_odd_sizes_equal_dense_float64(size, make_scene, dense, pose):
    scene = make_scene(30, scale=0.2)
    for layout, fov in (("equirect", None), ("pinhole", 90.0)):
        color, alpha, _ = dense(scene, pose, size, fov=fov)
        got = rasterize(scene, pose, size=size, layout=layout)
        assert got.color.shape == (3, *size) and got.alpha.shape == got.depth.shape == size
        assert (got.color - color).abs().max() < 1e-10 and (got.alpha - alpha).abs().max() < 1e-10


def test_discs_needles_and_points_equal_dense_float64(make_scene, dense, pose):
    for thin in ((0,), (0, 1), (0, 1, 2)):
        scene = make_scene(60, scale=0.2, seed=4)
        scales = scene.scales.clone()
        scales[:, thin] = 0
        scene = dataclasses.replace(scene, scales=scales)
        for lowpass in ("angular", "3dgs"):
            # Adjugates of singular matrices round differently; a needle's own determinant is 0 either way.
            color, alpha, _ = dense(scene, pose, (20, 40), lowpass=lowpass)
            got = rasterize(scene, pose, size=(20, 40), lowpass=lowpass)
            assert torch.isfinite(got.color).all()
            assert (got.color - color).abs().max() < 1e-6 and (got.alpha - alpha).abs().max() < 1e-6
        if len(thin) == 1:
            assert float(alpha.mean()) > 0.1


def test_camera_inside_gaussians_sees_them_all_around(make_scene, dense):
    scene = make_scene(12, scale=1.5, spread=0.6, seed=2)
    color, alpha, _ = dense(scene, _ORIGIN, (16, 32))
    got = rasterize(scene, _ORIGIN, size=(16, 32))
    assert float(alpha.min()) > 0
    assert (got.color - color).abs().max() < 1e-10
    faces = rasterize(scene, _ORIGIN, size=(16, 32), layout="pinhole", vertical_fov_degrees=140.0)
    color, _, _ = dense(scene, _ORIGIN, (16, 32), fov=140.0)
    assert (faces.color - color).abs().max() < 1e-10


def test_white_furnace_is_white(make_scene, pose):
    scene = make_scene(150, scale=0.2)
    grey = (torch.tensor((0.7, 0.3, 0.5), dtype=torch.float64) - 0.5) / 0.28209479177387814
    harmonics = torch.zeros_like(scene.harmonics)
    harmonics[:, 0] = grey
    scene = dataclasses.replace(scene, harmonics=harmonics)
    for layout in ("equirect", "cubemap", "pinhole"):
        for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-13)):
            got = rasterize(scene.to(dtype=dtype), pose, size=(32, 64), layout=layout, background=(0.7, 0.3, 0.5))
            white = torch.tensor((0.7, 0.3, 0.5), dtype=torch.float64)[:, None, None]
            assert (got.color - white).abs().max() < tolerance
            assert float(got.alpha.mean()) > 0.3


def test_colour_enters_linearly(make_scene, pose):
    scene = dataclasses.replace(make_scene(80, degree=0), harmonics=torch.rand(80, 1, 3).double())
    other = torch.rand(80, 1, 3).double()

    def draw(harmonics):
        return rasterize(dataclasses.replace(scene, harmonics=harmonics), pose, size=(16, 32)).color

    mixed = draw(0.3 * scene.harmonics + 0.7 * other)
    assert torch.allclose(mixed, 0.3 * draw(scene.harmonics) + 0.7 * draw(other), atol=1e-12)


@pytest.mark.parametrize("unit", [1e-3, 1e4])
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
def test_pictures_do_not_depend_on_the_unit_of_length(unit, kernel, make_scene, pose):
    scene = make_scene(80, scale=0.1).to(dtype=torch.float32)
    moved = pose.clone()
    moved[:3, 3] *= unit
    scaled = dataclasses.replace(scene, means=scene.means * unit, scales=scene.scales * unit)
    options = {"size": (24, 48), "kernel": kernel, "layout": "cubemap"}
    before = rasterize(scene, pose, **options)
    after = rasterize(scaled, moved, near=0.05 * unit, **options)
    assert (before.color - after.color).abs().max() < 5e-5
    assert torch.allclose(before.depth * unit, after.depth, rtol=1e-4)


def test_depths_from_millimetres_to_kilometres_draw_in_float32(dense):
    parts = [_ball((0.3 * r, 0.1 * r, r), 0.05 * r, 0.5) for r in (1e-3, 1e-1, 1.0, 1e2, 1e4)]
    scene = Gaussians.cat(parts)
    color, alpha, depth = dense(scene, _ORIGIN, (32, 64), near=1e-4)
    got = rasterize(scene.to(dtype=torch.float32), _ORIGIN, size=(32, 64), near=1e-4)
    assert (got.color - color).abs().max() < 3e-6 and (got.alpha - alpha).abs().max() < 3e-6
    assert torch.allclose((got.depth * got.alpha).double(), depth, rtol=1e-5)


def test_order_is_radial_or_by_depth_as_asked():
    aside = _ball((1.2, 0, 1.0), 0.5, 0.95, (1, 0, 0))  # nearer in z, farther in distance
    ahead = _ball((0.2, 0, 1.3), 0.5, 0.95, (0, 1, 0))
    scene = Gaussians.cat([aside, ahead])
    pictures = {
        order: rasterize(scene, _ORIGIN, size=(16, 16), layout="pinhole", order=order).color[:, 8, 12]
        for order in ("radial", "z")
    }
    assert pictures["radial"][1] > pictures["radial"][0]
    assert pictures["z"][0] > pictures["z"][1]


def test_ties_are_drawn_in_the_order_of_their_index():
    red, green = _ball((0, 0, 2.0), colour=(1, 0, 0)), _ball((0, 0, 2.0), colour=(0, 1, 0))
    for order in ("radial", "z"):
        for parts, front in (((red, green), 0), ((green, red), 1)):
            scene = Gaussians.cat(parts)
            middle = rasterize(scene, _ORIGIN, size=(15, 15), layout="pinhole", order=order).color[:, 7, 7]
            assert middle[front] > middle[1 - front] > 0


def test_radial_order_does_not_change_when_the_camera_turns(make_scene, pose):
    scene = make_scene(50, scale=0.4, seed=8)
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3] @ torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)
    a = rasterize(scene, pose, size=(16, 32))
    b = rasterize(scene, turned, size=(16, 32))
    assert torch.allclose(torch.roll(a.color, -8, dims=2), b.color, atol=1e-12)


def test_a_gaussian_nearer_than_near_is_left_out_by_distance():
    for mean in ((0, 0, 0), (0, 0, 1e-6), (0.03, 0, 0.03), (0.049, 0, 0)):
        got = rasterize(_ball(mean), _ORIGIN, size=(8, 16))
        assert float(got.alpha.max()) == 0 and got.info is not None and got.info.near == 1
    got = rasterize(_ball((0.03, 0.0, 0.042)), _ORIGIN, size=(8, 16))
    assert float(got.alpha.max()) > 0 and got.info is not None and got.info.near == 0


def test_what_is_behind_stays_behind():
    got = rasterize(_ball((0, 0, -2.0)), _ORIGIN, size=(16, 16), layout="pinhole", vertical_fov_degrees=150.0)
    assert float(got.alpha.max()) == 0
    panorama = rasterize(_ball((0, 0, -2.0)), _ORIGIN, size=(16, 32))
    assert float(panorama.alpha[:, 8:24].max()) == 0 and float(panorama.alpha.max()) > 0.05


@pytest.mark.parametrize("layout", ["equirect", "cubemap", "pinhole"])
def test_an_empty_scene_is_background(layout, make_scene, pose):
    full = make_scene(5)
    for scene in (
        full.select(torch.zeros(5, dtype=torch.bool)),
        dataclasses.replace(full, opacities=torch.zeros(5, dtype=torch.float64)),
        dataclasses.replace(full, opacities=torch.full((5,), -1.0, dtype=torch.float64)),
        dataclasses.replace(full, means=full.means * 0 + pose[:3, 3]),
    ):
        got = rasterize(scene, pose, size=(6, 12), layout=layout, background=(0.1, 0.2, 0.3))
        expected = torch.tensor((0.1, 0.2, 0.3), dtype=torch.float64)[:, None, None].expand(3, 6, 12)
        assert torch.allclose(got.color, expected, atol=1e-15)
        assert float(got.alpha.abs().max()) == float(got.depth.abs().max()) == 0


@pytest.mark.parametrize("field", ["means", "scales", "quats", "opacities", "harmonics"])
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf, 1e38])
def test_poison_never_reaches_the_picture(field, poison, make_scene, pose):
    scene = make_scene(20).to(dtype=torch.float32)
    value = getattr(scene, field).clone()
    value.reshape(20, -1)[7, -1] = poison
    poisoned = dataclasses.replace(scene, **{field: value})
    without = scene.select(torch.arange(20) != 7)
    expected = rasterize(without, pose, size=(12, 24), layout="cubemap")
    got = rasterize(poisoned, pose, size=(12, 24), layout="cubemap")
    assert torch.equal(got.color, expected.color) and torch.equal(got.depth, expected.depth)
    assert got.info is not None and got.info.dropped == 1
    with pytest.raises(InputError, match=r"1 of 20 that do not .*number 7.*strict=False"):
        rasterize(poisoned, pose, size=(12, 24), strict=True)


def test_quaternions_mean_their_direction_only(make_scene, pose):
    scene = make_scene(30)
    expected = rasterize(scene, pose, size=(12, 24)).color
    for factor in (-1.0, 2.0, 1e-6):
        got = rasterize(dataclasses.replace(scene, quats=factor * scene.quats), pose, size=(12, 24)).color
        assert torch.allclose(got, expected, atol=1e-12)
    upright = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(30, 4)
    zero = rasterize(dataclasses.replace(scene, quats=0 * scene.quats), pose, size=(12, 24)).color
    assert torch.equal(zero, rasterize(dataclasses.replace(scene, quats=upright), pose, size=(12, 24)).color)


def test_opacity_is_cut_at_one_255th_and_limited_at_99_hundredths():
    big = {"mean": (0, 0, 2.0), "sigma": 1.9}
    for opacity, expected in ((1.0, 0.99), (5.0, 0.99), (0.5, 0.5), (0.0039, 0.0), (0.00394, 0.00394)):
        middle = rasterize(
            _ball(opacity=opacity, **big), _ORIGIN, size=(15, 15), layout="pinhole", lowpass="3dgs"
        ).alpha[7, 7]
        assert float(middle) == pytest.approx(expected, abs=1e-12)


def test_a_thousand_gaussians_on_one_pixel_saturate_to_a_convex_mean():
    count = 1000
    generator = torch.Generator().manual_seed(0)
    ball = _ball((0, 0, 2.0), 0.5, 0.6)
    scene = ball.select(torch.zeros(count, dtype=torch.int64))
    harmonics = torch.rand(count, 1, 3, generator=generator, dtype=torch.float64)
    means = scene.means + 1e-3 * torch.arange(count, dtype=torch.float64)[:, None] * torch.tensor((0, 0, 1.0))
    scene = dataclasses.replace(scene, harmonics=harmonics, means=means).to(dtype=torch.float32)
    early = rasterize(scene, _ORIGIN, size=(9, 9), layout="pinhole")
    whole = rasterize(
        dataclasses.replace(scene, means=scene.means.clone().requires_grad_()),
        _ORIGIN,
        size=(9, 9),
        layout="pinhole",
    )
    assert torch.allclose(early.color, whole.color.detach(), atol=1e-6)  # stopping early changes nothing
    assert float((early.alpha[4, 4] - 1).abs()) < 1e-6
    colours = harmonics[:, 0].float() * 0.28209479177387814 + 0.5
    assert (early.color[:, 4, 4] <= colours.amax(0)).all() and (early.color[:, 4, 4] >= colours.amin(0)).all()
    assert 2.0 < float(early.depth[4, 4]) < 2.05


def test_the_angular_filter_keeps_the_energy_of_a_speck():
    height = 64
    weights = torch.cos(math.pi * ((torch.arange(height) + 0.5) / height - 0.5))[:, None]
    sigma = 0.5 * math.pi / height  # half a pixel
    exact = 2 * math.pi * 0.8 * sigma**2
    energies = []
    for shift in (0.0, 0.25, 0.5):
        turn = shift * 2 * math.pi / 128
        got = rasterize(_ball((math.sin(turn), 0.0, math.cos(turn)), sigma), _ORIGIN, size=(height, 128))
        energies.append(float((got.alpha * weights).sum()) * (math.pi / height) ** 2 / exact)
    assert all(abs(energy - 1) < 0.03 for energy in energies), energies


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_halves_are_drawn_in_float32(dtype, make_scene, pose):
    scene = make_scene(30).to(dtype=dtype)
    got = rasterize(scene, pose, size=(12, 24))
    expected = rasterize(scene.to(dtype=torch.float32), pose, size=(12, 24))
    assert got.color.dtype == torch.float32 and torch.equal(got.color, expected.color)


def test_the_number_of_threads_changes_no_bit(make_scene, pose):
    scene = make_scene(400, scale=0.1).to(dtype=torch.float32)
    before = torch.get_num_threads()
    try:
        pictures = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            pictures.append(rasterize(scene, pose, size=(32, 64)).color)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*pictures)


def test_arguments_out_of_range_are_refused(make_scene, pose, unchecked):
    scene = make_scene(2)
    cases = [
        ({"size": (0, 4)}, r"`size` must be \(height, width\).*\(0, 4\)"),
        ({"layout": "fisheye"}, r"`layout` must be one of equirect, cubemap, pinhole, got 'fisheye'"),
        ({"kernel": "box"}, "`kernel` must be one of ray, ewa"),
        ({"order": "random"}, "`order` must be one of radial, z"),
        ({"lowpass": "none"}, "`lowpass` must be one of angular, 3dgs"),
        ({"backend": "cuda"}, "`backend` must be one of auto, torch"),
        ({"near": 0.0}, "`near` must be a positive distance"),
        ({"vertical_fov_degrees": 180.0}, "`vertical_fov_degrees` must lie between 0 and 180"),
        ({"face_size": 0}, "`face_size` must be at least 1"),
        ({"kernel": "ewa"}, "'ewa' .* not defined on layout 'equirect'; use layout='cubemap'"),
    ]
    for options, message in cases:
        with pytest.raises(InputError, match=message):
            rasterize(scene, pose, **{"size": (4, 8), **options})
    for bad in (2 * pose, torch.diag(torch.tensor((1.0, 1, -1, 1))), pose * math.nan, torch.eye(3)):
        with pytest.raises(InputError, match="`cam2world` must be a rigid 4x4"):
            rasterize(scene, bad, size=(4, 8))
