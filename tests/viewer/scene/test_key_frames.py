"""Camera paths pass their key frames smoothly, files are read strictly, and films have the frames of the path."""

from dataclasses import replace

import av
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from pansplat.errors import InputError
from pansplat.geometry.world import WorldFrame
from pansplat_viewer.capture import SceneFrames, name_frame, write_path_film
from pansplat_viewer.draw.cpu_renderer import CpuRenderer
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.key_frames import CameraPath, KeyFrame, read_path, write_path
from pansplat_viewer.scene.settings import DrawSettings

LEVEL = Camera()
PATH = CameraPath(
    (
        KeyFrame(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        KeyFrame(0.5, (0.1, 0.0, 0.2), (0.3, -0.2, 1.0), 60.0),
        KeyFrame(1.0, (0.1, -0.1, 0.4), (1.0, 0.0, 1.0), 60.0),
    )
)


def test_a_path_passes_its_key_frames_and_overshoots_none():
    for frame in PATH.key_frames:
        camera = PATH.interpolate(frame.seconds, LEVEL)
        direction = np.array(frame.direction) / np.linalg.norm(frame.direction)
        assert np.allclose(camera.position, frame.position) and np.allclose(camera.rotation[:, 2], direction)
        assert camera.vertical_fov_degrees == pytest.approx(frame.vertical_fov_degrees)
    cameras = [PATH.interpolate(t, LEVEL) for t in np.linspace(-0.5, 1.5, 201)]
    positions = np.array([camera.position for camera in cameras])
    assert positions[:, 0].max() <= 0.1 + 1e-12 and np.all(np.diff(positions[:, 2]) >= -1e-12)
    assert np.abs(np.diff(positions[51:150], n=2, axis=0)).max() < 1e-3, "smooth"
    assert cameras[0] == PATH.interpolate(0, LEVEL) and cameras[-1] == PATH.interpolate(1, LEVEL)


def test_a_path_turns_the_short_way():
    frames = [KeyFrame(t, (0, 0, 0), (np.sin(yaw), 0, np.cos(yaw))) for t, yaw in ((0, 3.0), (1, -3.0))]
    middle = CameraPath(tuple(frames)).interpolate(0.5, LEVEL)
    assert np.allclose(middle.rotation[:, 2], (0, 0, -1))


def test_key_frames_are_level_in_the_axes_of_the_scene():
    camera = Camera((1.0, 2.0, 3.0), 0.7, -0.3, 50.0, level=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))
    path = CameraPath().add(KeyFrame.of_camera(camera, 0.0))
    again = path.interpolate(0.0, Camera(level=camera.level))
    assert np.allclose(again.cam2world, camera.cam2world) and again.vertical_fov_degrees == 50.0


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
        assert replace(frame_again, position=given.position) == given


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


@pytest.fixture
def frames(small_scene):
    renderer = CpuRenderer(None)
    yield SceneFrames(renderer, small_scene, (48, 32), DrawSettings(mode="deferred"))
    renderer.release()


def draw(frames, seconds):
    camera = PATH.interpolate(seconds, LEVEL)
    return frames.draw(camera.cam2world, camera.vertical_fov_degrees, seconds, with_depth=True)


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_each_frame_of_a_film_shows_the_path_at_its_time(frames, tmp_path, suffix):
    (file,) = write_path_film(frames, PATH, LEVEL, tmp_path / f"film{suffix}", 8.0, lambda task, done: None)
    with av.open(str(file)) as film:
        decoded = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in film.decode(video=0)]
    assert [round(8 * time) for time, _ in decoded] == list(range(9))
    images = [255 * draw(frames, i / 8)[0] for i in range(9)]
    for index, (_, image) in enumerate(decoded):
        errors = [np.abs(image - other).mean() for other in images]
        assert int(np.argmin(errors)) == index


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_sequence_has_a_file_for_each_frame(frames, tmp_path, suffix):
    files = write_path_film(frames, PATH, LEVEL, tmp_path / f"walk{suffix}", 2.0, lambda task, done: None)
    assert files == [name_frame(tmp_path / f"walk{suffix}", i) for i in range(3)]
    color, depth = draw(frames, 0.5)
    if suffix == ".png":
        with Image.open(files[1]) as image:
            assert np.abs(np.asarray(image) / 255 - color).max() <= 0.5 / 255 + 1e-6
    else:
        with OpenEXR.File(str(files[1])) as image:
            assert np.allclose(image.channels()["Z"].pixels, depth)
            assert image.channels()["RGB"].pixels.shape == color.shape


def test_a_film_that_fails_leaves_no_file(frames, tmp_path):
    def fail(task, done):
        if done > 0.5:
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        write_path_film(frames, replace(PATH), LEVEL, tmp_path / "film.mp4", 8.0, fail)
    assert list(tmp_path.iterdir()) == []


def test_a_path_stands_still_between_parts_and_jumps_at_the_later_key_frame(parted_house):
    places = ((0.0, 0, 0), (0, 0, 1), (20, 0, 1.6), (20.5, 0, 1.6), (0, 0, 0.5))
    path = CameraPath(tuple(KeyFrame(float(k), place, (0.0, 0, 1)) for k, place in enumerate(places)))
    times = (-1.0, 0.5, 1.0, 1.9, 2.0, 2.5, 3.9, 4.0, 9.0)
    shown = [path.interpolate(time, Camera(), parted_house).position for time in times]
    expected = [places[0], (0, 0, 0.5), *[places[1]] * 2, places[2], (20.25, 0, 1.6), places[3], *[places[4]] * 2]
    assert np.allclose(shown, expected)
    assert path.interpolate(1.5, Camera()).position[0] > 1, "in other scenes it flies"
