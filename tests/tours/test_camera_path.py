"""Camera paths pass their key frames smoothly, and their files are read strictly."""

from pathlib import Path

import numpy as np
import pytest
import torch
from msgspec import structs

from pansplat.errors import InputError
from pansplat.geometry.level import turn_axes
from pansplat.geometry.world import WorldFrame
from pansplat.inputs.panorama_sets import Panorama
from pansplat.tours.camera_path import CameraPath, KeyFrame, read_path, write_path
from pansplat.tours.graph import TourGraph

LEVEL = np.eye(3)
PATH = CameraPath(
    (
        KeyFrame(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        KeyFrame(0.5, (0.1, 0.0, 0.2), (0.3, -0.2, 1.0), 60.0),
        KeyFrame(1.0, (0.1, -0.1, 0.4), (1.0, 0.0, 1.0), 60.0),
    )
)


def test_a_path_passes_its_key_frames_and_overshoots_none():
    for frame in PATH.key_frames:
        pose, fov = PATH.interpolate(frame.seconds, LEVEL)
        direction = np.array(frame.direction) / np.linalg.norm(frame.direction)
        assert np.allclose(pose[:3, 3], frame.position) and np.allclose(pose[:3, 2], direction)
        assert fov == pytest.approx(frame.vertical_fov_degrees)
    poses = np.array([PATH.interpolate(t, LEVEL)[0] for t in np.linspace(-0.5, 1.5, 201)])
    positions = poses[:, :3, 3]
    assert positions[:, 0].max() <= 0.1 + 1e-12 and np.all(np.diff(positions[:, 2]) >= -1e-12)
    assert np.abs(np.diff(positions[51:150], n=2, axis=0)).max() < 1e-3, "smooth"
    assert np.array_equal(poses[0], PATH.interpolate(0, LEVEL)[0]), "it stands still before"
    assert np.array_equal(poses[-1], PATH.interpolate(1, LEVEL)[0]), "and after"


def test_a_path_turns_the_short_way():
    frames = [KeyFrame(t, (0, 0, 0), (np.sin(yaw), 0, np.cos(yaw))) for t, yaw in ((0, 3.0), (1, -3.0))]
    pose, _ = CameraPath(tuple(frames)).interpolate(0.5, LEVEL)
    assert np.allclose(pose[:3, 2], (0, 0, -1))


def test_key_frames_are_level_in_the_axes_of_the_scene():
    level, pose = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))), np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn_axes(level, 0.7, -0.3), (1, 2, 3)
    path = CameraPath().add(KeyFrame(0.0, tuple(pose[:3, 3]), tuple(pose[:3, 2]), 50.0))
    again, fov = path.interpolate(0.0, level)
    assert np.allclose(again, pose) and fov == 50.0


def test_a_camera_that_looks_down_has_the_heading_of_the_level_axes():
    pose, _ = CameraPath((KeyFrame(0.0, (0, 0, 0), (0, 2.0, 0)),)).interpolate(0.0, LEVEL)
    assert np.allclose(pose[:3, :3], ((1, 0, 0), (0, 0, 1), (0, -1, 0)))


def test_key_frames_stay_in_the_order_of_time():
    path = CameraPath().add(KeyFrame(2.0, (0, 0, 0), (0, 0, 1))).add(KeyFrame(1.0, (1, 0, 0), (0, 0, 1)))
    path = path.add(KeyFrame(2.0, (2, 0, 0), (0, 0, 1)))
    assert [(frame.seconds, frame.position[0]) for frame in path.key_frames] == [(1.0, 1), (2.0, 2)]
    assert path.remove(0).seconds == 2.0 and path.count_frames(10) == 21 and CameraPath().count_frames(10) == 1


def test_a_path_is_the_same_after_writing_and_reading(tmp_path):
    write_path(PATH, tmp_path / "path.json")
    assert read_path(tmp_path / "path.json") == PATH


def test_a_path_in_the_world_of_a_scene_and_back_is_the_same():
    frame = WorldFrame(1e3, (5e9, 0.0, 64e3))
    local = PATH.map_places(frame.localize_places)
    assert local.key_frames[0].position == pytest.approx((np.array(PATH.key_frames[0].position) - frame.origin) / 1e3)
    for frame_again, given in zip(local.map_places(frame.globalize_places).key_frames, PATH.key_frames, strict=True):
        assert frame_again.position == pytest.approx(given.position, abs=1e-5)
        assert structs.replace(frame_again, position=given.position) == given


FRAME = '{"seconds": 0, "position": [0, 0, 0], "direction": [0, 0, 1]}'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{}", 'needed one or more "key_frames", got none'),
        ('{"key_frames": [], "speed": 1}', "needed only known fields, got 'speed'"),
        (f'{{"key_frames": [{FRAME}, {FRAME}]}}', 'key_frames[1]: needed "seconds" after 0, got 0'),
        (f'{{"key_frames": [{FRAME.replace("[0, 0, 1]", "[0, 0, 0]")}]}}', 'needed a "direction" with a length'),
        (f'{{"key_frames": [{FRAME[:-1]}, "vertical_fov_degrees": 200}}]}}', "needed a number <= 130"),
    ],
)
def test_invalid_files_are_refused(tmp_path, text, message):
    file = tmp_path / "path.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"path\.json") as error:
        read_path(file)
    assert message in str(error.value)


def test_a_path_stands_still_between_parts_and_jumps_at_the_later_key_frame():
    poses = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    poses[:, :3, 3] = torch.tensor(((0.0, 0, 0), (0, 0, 0.8), (0, 0, 1.6), (20, 0, 1.6)))
    views = tuple(Panorama(f"room{k}", Path(f"room{k}.png"), pose) for k, pose in enumerate(poses))
    parted = TourGraph("house", Path(), views, 0.45, 10.0, (), {(0, 1): 0.4, (1, 2): 0.4, (3, 3): 1.0})
    places = ((0.0, 0, 0), (0, 0, 1), (20, 0, 1.6), (20.5, 0, 1.6), (0, 0, 0.5))
    path = CameraPath(tuple(KeyFrame(float(k), place, (0.0, 0, 1)) for k, place in enumerate(places)))
    times = (-1.0, 0.5, 1.0, 1.9, 2.0, 2.5, 3.9, 4.0, 9.0)
    shown = [path.interpolate(time, LEVEL, parted)[0][:3, 3] for time in times]
    expected = [places[0], (0, 0, 0.5), *[places[1]] * 2, places[2], (20.25, 0, 1.6), places[3], *[places[4]] * 2]
    assert np.allclose(shown, expected)
    assert path.interpolate(1.5, LEVEL)[0][0, 3] > 1, "in other scenes it flies"
