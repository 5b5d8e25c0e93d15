"""Folders with pictures that do not belong together: what can be placed is placed, the rest is named."""

import math
import shutil

import cv2
import numpy as np
import pytest

from pansplat.poses.estimate import PoseEstimate, estimate_poses
from pansplat.poses.solvers import angle_between, rotation_angle, rotation_exp

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_samples")]
POSES = {
    "a": (np.eye(3), np.zeros(3)),
    "b": (rotation_exp(np.array((0, 0.5, 0))), np.array((0.5, 0, 0.4))),
    "mirrored": (np.eye(3), np.array((-0.3, 0, 0.5))),
    "other_room": (np.eye(3), np.array((0.3, 0, -0.2))),
}


@pytest.fixture(scope="module")
def estimate(tmp_path_factory: pytest.TempPathFactory, render_room, few_samples: None) -> PoseEstimate:
    """Of two good pictures and others that have no pose; the distance of the good ones is given."""
    folder = tmp_path_factory.mktemp("rooms")
    for name, pose in POSES.items():
        image = render_room(int(name == "other_room"), *pose)
        cv2.imwrite(str(folder / f"{name}.png"), image[:, ::-1] if name == "mirrored" else image)
    cv2.imwrite(str(folder / "dark.png"), np.full((64, 128, 3), 3, np.uint8))
    cv2.imwrite(str(folder / "narrow.png"), np.full((64, 96, 3), 90, np.uint8))
    shutil.copy(folder / "a.png", folder / "z_copy.png")
    return estimate_poses(sorted(folder.glob("*.png")), baseline=("a.png", "b.png", 2.0))


def test_good_pictures_among_others_have_their_poses(estimate: PoseEstimate) -> None:
    found = {path.stem: pose for path, pose in estimate.poses.items()}
    assert sorted(found) == ["a", "b"]
    relative = np.linalg.inv(found["a"]) @ found["b"]
    assert math.degrees(rotation_angle(relative[:3, :3] @ POSES["b"][0].T)) < 0.1
    assert math.degrees(angle_between(relative[:3, 3], POSES["b"][1])) < 0.5


def test_a_given_distance_sets_the_scale(estimate: PoseEstimate) -> None:
    centres = [pose[:3, 3] for pose in estimate.poses.values()]
    assert np.linalg.norm(centres[0] - centres[1]) == pytest.approx(2.0)
    assert estimate.groups[0].scale_source == "a.png and b.png are 2 m apart"


def test_the_reason_names_the_picture(estimate: PoseEstimate) -> None:
    reasons = {path.stem: reason for path, reason in estimate.unplaced.items()}
    assert sorted(reasons) == ["dark", "mirrored", "narrow", "other_room", "z_copy"]
    assert "too dark" in reasons["dark"] and "2:1" in reasons["narrow"] and "copy of a.png" in reasons["z_copy"]
    assert "mirrored left to right" in reasons["mirrored"]
    assert "take one in the doorway (it has most in common with " in reasons["other_room"]
    assert not any(letter.isdigit() for letter in reasons["other_room"])
