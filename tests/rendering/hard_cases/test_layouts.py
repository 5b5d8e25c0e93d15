"""Hard cases 32 and 33: stitching at seams, corners and poles, and back-propagation face by face."""

import math

import pytest
import torch

from pansplat.geometry.cubemap import face_poses
from pansplat.rendering.image_planes import stitch_faces


@pytest.mark.hard_case(32)
@pytest.mark.parametrize("stitching", ["seamless", "official"])
@pytest.mark.parametrize("size", [(8, 16), (32, 64)])
def test_stitching_and_its_gradient_are_adjoint(stitching, size):
    """<A x, y> = <x, A' y>."""
    generator = torch.Generator().manual_seed(0)
    faces = torch.randn(6, 2, 5, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, *size, generator=generator, dtype=torch.float64)
    (adjoint,) = torch.autograd.grad(stitch_faces(faces, size, stitching=stitching), faces, weights)
    other = torch.randn(6, 2, 5, 5, generator=generator, dtype=torch.float64)
    left, right = (stitch_faces(other, size, stitching=stitching) * weights).sum(), (other * adjoint).sum()
    assert float((left - right).abs() / left.abs()) < 1e-12


@pytest.mark.slow
@pytest.mark.hard_case(32)
def test_the_cubemap_and_the_direct_panorama_have_no_seam(render, balls, yaw):
    """A sphere on an edge of the cube and in the middle of a face gives the same image, up to the faces' pixels."""
    size = (8, 16)
    for mean in ((0.0, 0.0, 2.0), (0.0, 1.4, 1.4), (1.1, 1.1, 1.1)):
        scene = balls(mean, 0.7)
        for layout, tolerance in (("equirect", 20 * render.image), ("cubemap", 0.06)):
            still = render(scene, size=size, layout=layout, face_size=12).alpha
            turned = render(scene, yaw(math.pi / 4), size=size, layout=layout, face_size=12).alpha
            assert float(still.max()) > 0.3
            assert float((torch.roll(still, -2, dims=1) - turned).abs().max()) < tolerance, (mean, layout)


@pytest.mark.slow
@pytest.mark.hard_case(33)
@pytest.mark.parametrize("kernel", ["ray", "ewa"])
@pytest.mark.parametrize("stitching", ["seamless", "official"])
def test_backpropagation_face_by_face_equals_backpropagation(kernel, stitching, render, make_scene, pose, leaves):
    """Rasterise without gradients, compute the gradients of the faces' pixels, then rasterise each face again."""
    render.skip_interpreted(stitching == "official" or kernel == "ray")
    num, size = 6, (8, 16)
    scene = make_scene(8, scale=0.4, degree=1).to(dtype=render.dtype)
    weights = torch.rand(3, *size, generator=torch.Generator().manual_seed(0)).to(render.dtype)
    options = {"kernel": kernel, "order": "z", "lowpass": "3dgs"}
    whole = leaves(scene)
    image = render(whole, pose, size=size, layout="cubemap", face_size=num, stitching=stitching, **options).color
    (image.square() * weights).sum().backward()

    def face(inputs, camera):
        return render(inputs, camera, size=(num, num), layout="pinhole", **options).color

    poses = face_poses(pose)
    with torch.no_grad():
        faces = torch.stack([face(scene, camera) for camera in poses])
    faces.requires_grad_()
    stitched = stitch_faces(faces, size, stitching=stitching)
    assert (stitched - image).detach().abs().max() < render.image
    (stitched.square() * weights).sum().backward()
    parts = leaves(scene)
    for camera, gradient in zip(poses, faces.grad, strict=True):
        face(parts, camera).backward(gradient)
    for name in ("means", "scales", "quats", "opacities", "harmonics"):
        found, expected = getattr(parts, name).grad, getattr(whole, name).grad
        assert float((found - expected).norm() / expected.norm()) < max(1e-6, render.gradient / 20), name
