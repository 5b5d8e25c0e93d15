"""Every convention gives the same camera, and invalid poses are refused with the reason."""

import math

import pytest
import torch
from refusals import expect_error
from synthetic_scenes import turn_camera

from pansplat.errors import InputError
from pansplat.inputs.poses import CONVENTIONS, parse_convention, rigid_matrix, to_cam2world

POSE = turn_camera((0.7, 0.3, -0.5, 0.4), (1.0, -2.0, 0.5))


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_every_convention_gives_the_same_camera(convention: str) -> None:
    flip = torch.diag(torch.tensor((1.0, -1.0, -1.0, 1.0), dtype=torch.float64))
    own = POSE @ flip if convention.endswith("opengl") else POSE
    stated = torch.linalg.inv(own) if convention.startswith("world2cam") else own
    matrix = rigid_matrix(stated.tolist(), "test")
    assert torch.allclose(to_cam2world(matrix, convention), POSE, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("cam2world opencv", "cam2world opencv"),
        (
            "cam2world 4x4, OpenCV axes (x right, y down, z forward), metres; the centre looks along +z",
            "cam2world opencv",
        ),
        ("c2w, Habitat", "cam2world opengl"),
        ("camera-to-world / OpenGL", "cam2world opengl"),
        ("world2cam COLMAP", "world2cam opencv"),
        ("World to Camera, NeRF axes", "world2cam opengl"),
    ],
)
def test_free_text_conventions_are_understood(text: str, meaning: str) -> None:
    assert parse_convention(text, "poses.json") == meaning


@pytest.mark.parametrize(
    "text", [None, "", "cam2world", "opencv", "cam2world or world2cam, opencv", "opencv opengl c2w", 3]
)
def test_unknown_conventions_are_refused_with_the_valid_names(text) -> None:
    with pytest.raises(InputError) as caught:
        parse_convention(text, "poses.json")
    assert str(caught.value).startswith("poses.json: needed")
    assert all(name in str(caught.value) for name in CONVENTIONS)


def test_a_pose_may_have_three_rows() -> None:
    assert torch.equal(rigid_matrix(POSE[:3].tolist(), "test"), POSE)


def test_rounded_files_give_exact_rotations() -> None:
    rounded = (POSE * 1e3).round() / 1e3
    rotation = rigid_matrix(rounded.tolist(), "test")[:3, :3]
    assert (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-12
    assert (rotation - POSE[:3, :3]).abs().max() < 1e-3


def _changed(**entries: float) -> list:
    pose = POSE.clone()
    for key, value in entries.items():
        pose[int(key[1]), int(key[2])] = value
    return pose.tolist()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (None, "none"),
        ([[1.0, 0.0], [0.0, 1.0]], r"\(2, 2\)"),
        (_changed(m00=math.nan), "NaN or infinite"),
        (_changed(m03=math.inf), "NaN or infinite"),
        (_changed(m00=3.0), "no rotation"),
        (_changed(m33=2.0), "bottom row"),
        (POSE.T.tolist(), "transposed"),
        ((POSE @ torch.diag(torch.tensor((1.0, 1.0, -1.0, 1.0), dtype=torch.float64))).tolist(), "mirrored"),
        ((POSE @ torch.diag(torch.tensor((2.0, 2.0, 2.0, 1.0), dtype=torch.float64))).tolist(), "scaled by 2"),
    ],
)
def test_matrices_that_are_not_rigid_are_refused_with_the_reason(values, message: str) -> None:
    expect_error(f"^poses.json, 'a.png': .*{message}", rigid_matrix, values, "poses.json, 'a.png'")
