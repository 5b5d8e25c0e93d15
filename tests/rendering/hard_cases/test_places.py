"""Hard cases 1 to 9: positions of Gaussians, from none to all around the camera."""

import dataclasses
import math

import pytest
import torch

from pansplat.geometry.cubemap import face_poses

_EYE = torch.eye(4, dtype=torch.float64)


@pytest.mark.slow
@pytest.mark.hard_case(1)
@pytest.mark.parametrize("layout", ["equirect", "cubemap", "pinhole"])
def test_an_empty_scene_is_background_and_gradients_of_zero(layout, render, balls, gradients):
    full = balls([(0, 0, 2.0), (1.0, 0, 1)])
    scenes = {
        "none": full.select(torch.zeros(2, dtype=torch.bool)),
        "transparent": dataclasses.replace(full, opacities=torch.zeros(2, dtype=torch.float64)),
        "too near": dataclasses.replace(full, means=0.01 * full.means),
        "not finite": dataclasses.replace(full, means=full.means * math.nan),
    }
    for name, scene in scenes.items():
        got = render(scene, layout=layout, background=(0.1, 0.25, 0.5))
        expected = torch.tensor((0.1, 0.25, 0.5), dtype=render.dtype)[:, None, None].expand(3, *render.size)
        assert torch.equal(got.color, expected), name
        assert float(got.alpha.abs().max()) == float(got.depth.abs().max()) == 0
        assert got.info is not None and got.info.intersections == 0
        for field, gradient in gradients(render, scene, layout=layout).items():
            shape = (4, 4) if field == "pose" else getattr(scene, field).shape
            assert gradient.shape == shape and not gradient.any(), (name, field)


@pytest.mark.slow
@pytest.mark.hard_case(2)
@pytest.mark.parametrize("mean", [(0, 0, 2.0), (1.0, -0.7, 1.3)])
@pytest.mark.parametrize("options", [{}, {"layout": "pinhole"}, {"layout": "pinhole", "kernel": "ewa"}])
def test_a_single_gaussian_and_its_gradients_equal_the_dense_renderer(mean, options, render, balls, equals_dense):
    scene = balls(mean, sigma=0.3)
    scales = torch.tensor([[0.4, 0.2, 0.3]], dtype=torch.float64)
    quats = torch.tensor([[0.8, 0.3, -0.4, 0.2]], dtype=torch.float64)
    equals_dense(render, dataclasses.replace(scene, scales=scales, quats=quats), **options)


@pytest.mark.hard_case(3)
def test_a_centre_on_an_edge_or_corner_gives_the_same_image_on_every_face(render, balls):
    poses = face_poses(_EYE)

    def face(scene, index):
        return render(scene, poses[index], size=(render.height, render.height), layout="pinhole").color.double()

    edge = balls((1.4, 0, 1.4), 0.3)
    front, right = face(edge, 0), face(edge, 1)
    assert float(front.max()) > 0.1
    assert torch.allclose(front, right.flip(2), atol=20 * render.image)
    corner = balls((1.2, 1.2, 1.2), 0.4)
    sums = [float(face(corner, index).sum()) for index in (0, 1, 5)]
    assert min(sums) > 0.1
    assert sums == pytest.approx([sums[0]] * 3, rel=1e-5)


@pytest.mark.hard_case(3)
def test_gradients_of_a_centre_on_an_edge_are_the_rotated_ones_of_a_faces_middle(render, balls, leaves, yaw):
    def gradients(mean):
        scene = leaves(balls(mean, 0.3).to(dtype=render.dtype))
        render(scene, size=(8, 16)).depth.sum().backward()  # does not depend on rotations about y
        return scene

    middle, edge = gradients((0, 0, 2.0)), gradients((math.sqrt(2), 0, math.sqrt(2)))
    turn = yaw(math.pi / 4)[:3, :3].to(render.dtype)
    for name, expected in (("means", middle.means.grad @ turn.T), ("opacities", middle.opacities.grad)):
        found = getattr(edge, name).grad
        scale = float(middle.means.grad.abs().max())
        assert scale > 0.1 and torch.allclose(found, expected, rtol=1e-4, atol=1e-4 * scale)


@pytest.mark.hard_case(4)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_centre_at_a_pole_fills_its_rows_evenly(side, render, balls, gradients):
    scene = balls((0.0, 2.0 * side, 0.0), 0.4)
    alpha = render(scene).alpha
    rows = alpha if side > 0 else alpha.flip(0)
    assert float(rows[-1].min()) > 0.3 and float(rows[0].max()) == 0
    assert torch.allclose(alpha, alpha[:, :1].expand_as(alpha), atol=2 * render.image)
    assert all(torch.isfinite(gradient).all() for gradient in gradients(render, scene).values())


@pytest.mark.hard_case(5)
def test_there_is_no_seam_at_180_degrees(render, balls, make_scene, gradients, yaw):
    behind = balls((0.0, 0.3, -2.0), 0.5)
    alpha = render(behind).alpha
    assert float(alpha[:, 0].max()) > 0.3
    assert torch.allclose(alpha, alpha.flip(1), atol=2 * render.image)
    scene, half = make_scene(12, scale=0.4, degree=0), render.height
    still, turned = render(scene), render(scene, yaw(math.pi))
    far = (torch.roll(still.color, -half, dims=2) - turned.color).abs()
    assert float(far.max()) < 20 * render.image
    assert all(torch.isfinite(gradient).all() for gradient in gradients(render, behind).values())


@pytest.mark.slow
@pytest.mark.hard_case(6)
@pytest.mark.parametrize("mean", [(0, 0, 0), (0, 0, 1e-6), (0.03, 0, 0.03), (0.049, 0, 0)])
@pytest.mark.parametrize("layout", ["equirect", "cubemap"])
def test_gaussians_nearer_than_near_are_missing_on_every_face(mean, layout, render, balls, gradients):
    render.skip_interpreted(layout == "cubemap" and any(mean))
    scene = balls([mean, (0, 0, 2.0)], 0.3)
    got = render(scene, layout=layout)
    assert got.info is not None and got.info.near == 1 and got.info.dropped == 0
    alone = render(balls((0, 0, 2.0), 0.3), layout=layout)
    assert torch.equal(got.color, alone.color)
    for name, gradient in gradients(render, scene, layout=layout).items():
        assert torch.isfinite(gradient).all()
        assert name == "pose" or (not gradient[0].any() and gradient[1].any()) or name == "quats"


@pytest.mark.hard_case(7)
def test_alpha_is_a_step_at_near_and_smooth_beyond_it(render, balls, leaves):
    """Section 1 of docs/rendering.md gives the reason for the step."""
    near = 0.5
    middle = (render.height // 2, render.height)

    def alpha(distance: float) -> float:
        return float(render(balls((0, 0, distance), 0.2), near=near).alpha[middle])

    assert alpha(near * (1 - 1e-5)) == 0
    outside = [alpha(near * (1 + step)) for step in (1e-5, 1e-3, 2e-3)]
    assert min(outside) > 0.4
    assert abs(outside[1] - outside[0]) < 1e-3
    scene = leaves(balls((0, 0, near * 1.01), 0.2).to(dtype=render.dtype))
    render(scene, near=near).alpha[middle].backward()
    step = 1e-3
    gradient = (alpha(near * 1.01 + step) - alpha(near * 1.01 - step)) / (2 * step)
    assert float(scene.means.grad[0, 2]) == pytest.approx(gradient, rel=0.02, abs=1e-3)


@pytest.mark.hard_case(8)
def test_gaussians_behind_a_pinhole_camera_are_not_rendered(render, balls, gradients):
    for mean in ((0, 0, -2.0), (0.5, 0.2, -2.0), (1.0, 0, -0.9)):
        scene = balls(mean, 0.1)
        for kernel in ("ray", "ewa"):
            options = {"layout": "pinhole", "size": (8, 8), "vertical_fov_degrees": 100.0, "kernel": kernel}
            assert not render(scene, **options).alpha.any()
            assert not any(gradient.any() for gradient in gradients(render, scene, **options).values())
    panorama = render(balls((0, 0, -2.0), 0.3)).alpha
    half = render.height // 2
    assert not panorama[:, half:-half].any() and float(panorama.max()) > 0.1


@pytest.mark.hard_case(9)
@pytest.mark.parametrize("options", [{}, {"layout": "pinhole", "vertical_fov_degrees": 140.0}], ids=["all", "pinhole"])
def test_a_camera_inside_gaussians_sees_them_all_around(options, render, make_scene, equals_dense):
    scene = make_scene(8, scale=1.2, extent=0.6, seed=2, degree=0)
    scene = scene.select(scene.means.norm(dim=1) > 0.1)
    assert float(render(scene, **options).alpha.mean()) > 0.8
    equals_dense(render, scene, **options, slack=2)
