"""Metadata of panoramas: gravity, compass, and pictures that are not whole panoramas."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pansplat.poses.axes import RotationPrior, SceneAxes, with_hints
from pansplat.poses.hints import read_hints
from pansplat.poses.solvers import rotation_exp

_PACKET = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {attributes}>{elements}'
    "</rdf:Description></rdf:RDF></x:xmpmeta>"
)


def _write(path: Path, elements: str = "", **tags: float | str) -> Path:
    attributes = " ".join(f'GPano:{name}="{value}"' for name, value in tags.items())
    packet = _PACKET.format(attributes=attributes, elements=elements).encode()
    Image.new("RGB", (8, 4)).save(path, xmp=packet)
    return path


def test_pitch_and_roll_give_gravity_in_the_cameras_frame(tmp_path: Path) -> None:
    for pitch, roll, down in ((0, 0, (0, 1, 0)), (90, 0, (0, 0, -1)), (0, 90, (1, 0, 0))):
        hints = read_hints(_write(tmp_path / "a.jpg", PosePitchDegrees=pitch, PoseRollDegrees=roll))
        assert hints.down is not None and np.allclose(hints.down, down, atol=1e-12)


def test_tags_may_be_elements(tmp_path: Path) -> None:
    element = "<GPano:PoseHeadingDegrees>90.0</GPano:PoseHeadingDegrees>"
    assert read_hints(_write(tmp_path / "a.jpg", element)).heading == pytest.approx(math.pi / 2)


def test_files_without_tags_have_no_hints(tmp_path: Path) -> None:
    Image.new("RGB", (8, 4)).save(tmp_path / "a.png")
    (tmp_path / "b.jpg").write_text("no picture")
    for name in ("a.png", "b.jpg", "none.jpg"):
        hints = read_hints(tmp_path / name)
        assert hints.down is None and hints.heading is None and hints.problem is None
    assert read_hints(_write(tmp_path / "c.jpg", PoseHeadingDegrees="north")).heading is None


def test_cropped_panoramas_and_other_projections_are_named(tmp_path: Path) -> None:
    crop = {
        "FullPanoWidthPixels": 4000, "FullPanoHeightPixels": 2000,
        "CroppedAreaImageWidthPixels": 4000, "CroppedAreaImageHeightPixels": 1000,
    }  # fmt: skip
    assert "360 x 90 degrees" in str(read_hints(_write(tmp_path / "a.jpg", **crop)).problem)
    crop["CroppedAreaImageHeightPixels"] = 2000
    assert read_hints(_write(tmp_path / "b.jpg", **crop)).problem is None
    assert "'cylindrical'" in str(read_hints(_write(tmp_path / "c.jpg", ProjectionType="cylindrical")).problem)


def test_gravity_of_the_picture_comes_before_that_of_the_metadata() -> None:
    tilted, rolled = np.array((math.sin(0.1), math.cos(0.1), 0)), np.array((1.0, 0, 0))
    for has_down, down in itertools.product((True, False), (tilted, rolled, -rolled)):
        axes = with_hints(SceneAxes(np.array(((0.0, 1, 0), (0, 0, 1), (1, 0, 0))), has_down, False), down, None)
        assert axes.has_down and np.allclose(axes.axes[0], (0, 1, 0) if has_down else down)
        assert np.allclose(axes.axes @ axes.axes.T, np.eye(3)) and np.linalg.det(axes.axes) > 0


def test_gravity_of_the_metadata_keeps_the_yaw_of_the_picture() -> None:
    axes = SceneAxes(np.array(((0.0, 1, 0), (0, 0, 1), (1, 0, 0))), False, False)
    down = np.array((0.1, 1.0, 0.1)) / math.sqrt(1.02)  # tilted by 8 degrees between both walls' normals
    wall = with_hints(axes, down, None).axes[1]
    assert abs(wall @ axes.axes[1]) > math.cos(math.radians(8.1))


def test_the_compass_prefers_rotations_that_keep_north() -> None:
    unknown = SceneAxes(np.eye(3), False, False)
    prior = RotationPrior(with_hints(unknown, None, 0.0), with_hints(unknown, None, math.radians(60)))
    # A camera that looks 60 degrees clockwise of north sees the first camera's forward direction on its left.
    scores = [prior.score(rotation_exp(np.array((0, math.radians(turn), 0)))) for turn in (-60, -40, 60, 120)]
    assert scores == sorted(scores, reverse=True) and scores[0] > 1 > 0 > scores[-1]
