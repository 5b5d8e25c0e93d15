"""Image planes, and stitching of cube faces against geometry and the official code's fixtures."""

import pytest
import torch

from pansplat.geometry.cubemap import face_of, face_rotations, official_faces
from pansplat.geometry.equirect import pixel_directions, uv_from_directions
from pansplat.rendering.image_planes import ImagePlane, image_planes, stitch_faces


@pytest.mark.shared
def test_depth_along_an_axis_becomes_distance_by_the_official_factor(golden):
    ahead = ImagePlane((32, 32), face_rotations()[0], 16.0).directions()[..., 2]
    assert torch.allclose(1 / ahead, golden("units")["cubemap.depth_norm"].double(), rtol=0, atol=2e-7)


def test_stitching_reproduces_the_direction_of_every_pixel_across_edges_and_corners():
    expected = pixel_directions(64, 128, dtype=torch.float64).permute(2, 0, 1)
    # Bilinear within a face, and a neighbour's pixel is less than a pixel from its ideal position.
    for num, tolerance in ((16, 0.05), (64, 0.012)):
        faces = torch.stack([plane.directions() for plane in image_planes("cubemap", (64, 128), face_size=num)])
        stitched = stitch_faces(faces.permute(0, 3, 1, 2), (64, 128))
        assert float((stitched - expected).norm(dim=0).max()) < tolerance
    uv = uv_from_directions(stitched.permute(1, 2, 0))
    assert float((uv[..., 1] - (torch.arange(64) + 0.5)[:, None] / 64).abs().max()) < 0.005


@pytest.mark.shared
def test_official_faces_equal_the_fixture(golden):
    assert torch.equal(official_faces(64), golden("units")["cubemap.face"].long())


@pytest.mark.shared
def test_official_stitching_equals_the_fixture(golden):
    fixtures = golden("units")
    expected = fixtures["cubemap.pano_out"][0].double()
    got = stitch_faces(fixtures["cubemap.faces_in"][0].double(), (64, 128), official=True)
    # The official code samples float32 positions in a strip of six padded faces, 204 pixels long, where neighbouring
    # numbers are 1.5e-5 apart; the fixture's faces are noise, up to 1 from pixel to pixel.
    assert float((got - expected).abs().max()) < 3e-5


@pytest.mark.shared
def test_the_two_stitchings_differ_only_next_to_the_up_and_down_faces(golden):
    faces = golden("units")["cubemap.faces_in"][0].double()
    official, seamless = (stitch_faces(faces, (64, 128), official=o) for o in (True, False))
    differ = (official - seamless).abs().amax(dim=0) > 1e-12
    assert 0 < int(differ.sum()) <= 96
    up_or_down = face_of(pixel_directions(64, 128, dtype=torch.float64)) >= 4
    grown = torch.nn.functional.max_pool2d(up_or_down[None].float(), 3, 1, 1)[0] > 0
    assert not (differ & ~grown).any()
