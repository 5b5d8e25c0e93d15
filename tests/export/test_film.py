"""Films: the frames of paths and flights in files, and photographs: where they are shown, how they fade, what masks
hide."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls

from pansplat.export.film import Film, FilmPhotographs, follow_path, list_flight, write_film
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import pixel_directions
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.rendering.image_planes import image_planes
from pansplat.tours.camera_path import CameraPath, KeyFrame
from pansplat.tours.route import STOP_SECONDS

POSES = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
POSES[1, :3, :3] = torch.tensor(((0.0, 0, 1), (0, 1, 0), (-1, 0, 0)))  # looks to the right
POSES[1, 0, 3] = 2.0
(PLANE,) = image_planes("pinhole", (48, 64), vertical_fov_degrees=60.0)
GAUSSIANS = np.full((48, 64, 3), 0.25, dtype=np.float32)


@pytest.fixture
def photographs(tmp_path: Path) -> list[PanoramaSet]:
    """Two panoramas whose colours are directions of the world; a mask hides the upper half of the second one."""
    pairs = []
    for index, pose in enumerate(POSES):
        colors = 0.5 + 0.5 * pixel_directions(128, 256).double() @ pose[:3, :3].T
        image, mask = tmp_path / f"{index}.png", tmp_path / "masks" / f"{index}.png"
        cv2.imwrite(str(image), (255 * colors.numpy()[..., ::-1]).round().astype(np.uint8))
        mask.parent.mkdir(exist_ok=True)
        white = np.full((128, 256), 255, dtype=np.uint8)
        white[: 64 * index] = 0
        cv2.imwrite(str(mask), white)
        view = Panorama(str(index), image, pose, mask=mask)
        pairs.append(PanoramaSet(str(index), tmp_path, (view,), (), 0.5, 10.0))
    return pairs


def move(index: int, right: float) -> np.ndarray:
    """The pose of a camera to the right of a panorama, which looks back and up."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array((0.2, 2.8, 0.1)))[0]
    pose[:3, 3] = POSES[index, :3, 3].numpy() + np.array((right, 0, 0))
    return pose


def directions(pose: np.ndarray) -> np.ndarray:
    """The colours of the photographs as a camera sees them."""
    return 0.5 + 0.5 * PLANE.directions().numpy() @ pose[:3, :3].T


def test_the_photograph_is_shown_at_its_panorama_and_fades_as_the_camera_leaves(photographs: list[PanoramaSet]) -> None:
    stops, drawn = FilmPhotographs(photographs, POSES), []

    def mix(right: float, seconds: float) -> float:
        def draw() -> np.ndarray:
            drawn.append(seconds)
            return GAUSSIANS

        pose = move(0, right)
        image, photograph = stops.mix([(pose, 1.0, draw)], PLANE, seconds), directions(pose)
        weight = ((image - GAUSSIANS) * (photograph - GAUSSIANS)).sum() / ((photograph - GAUSSIANS) ** 2).sum()
        assert np.abs(image - (GAUSSIANS + weight * (photograph - GAUSSIANS))).max() < 0.01
        return weight

    assert mix(0.0, 5.0) == pytest.approx(1, abs=0.01) and not drawn, "at once, without the Gaussians"
    assert mix(0.02, 5.1) == pytest.approx(1, abs=0.01) and not drawn
    assert mix(0.04, 5.1 + STOP_SECONDS / 4) == pytest.approx(0.75, abs=0.01)
    assert mix(0.2, 5.1 + STOP_SECONDS) == pytest.approx(0, abs=0.01)
    assert mix(0.01, 6.0 + STOP_SECONDS / 2) == pytest.approx(1, abs=0.01), "a long step"
    assert mix(0.5, 9.0) == 0


def test_a_frame_mixes_the_photographs_of_two_panoramas_without_what_masks_hide(photographs: list[PanoramaSet]) -> None:
    poses = [move(0, 0.0), move(1, 0.0)]
    stops = FilmPhotographs(photographs, POSES)
    frame = [(pose, share, lambda: GAUSSIANS) for pose, share in zip(poses, (0.25, 0.75), strict=True)]
    image = stops.mix(frame, PLANE, 0.0)
    first, second = map(directions, poses)
    height = 1 - 2 * second[..., 1]  # of a direction above the horizon
    for chosen, shown in ((height > 0, GAUSSIANS), (height < -0.1, second)):
        assert chosen.sum() > 200
        assert np.abs(image - (0.25 * first + 0.75 * shown))[chosen].max() < 0.01


def test_exposures_become_that_of_the_gaussians(photographs: list[PanoramaSet]) -> None:
    pose = move(0, 0.0)
    stops = FilmPhotographs(photographs, POSES, ((1.25, 1.0, 2.0), (1.0, 1.0, 1.0)))
    image = stops.mix([(pose, 1.0, lambda: GAUSSIANS)], PLANE, 0.0)
    assert np.abs(image - directions(pose) / (1.25, 1.0, 2.0)).max() < 0.01


def test_without_photographs_the_frame_is_drawn(photographs: list[PanoramaSet]) -> None:
    stops = FilmPhotographs((), POSES)
    assert (stops.mix([(move(0, 0.0), 1.0, lambda: GAUSSIANS)], PLANE, 0.0) == GAUSSIANS).all()


PATH = CameraPath((KeyFrame(0.0, (0, 0, 0), (0, 0, 1)), KeyFrame(1.0, (0, 0, 0.8), (0, 0, 1), 60.0)))


@pytest.fixture
def scene() -> Scene:
    return Scene(make_balls(torch.tensor(((0.0, 0, 2),)), 0.3), POSES, 0.5, 10.0)


def make_film(scene: Scene) -> Film:
    """Grey frames, whose brightness is the distance of the camera."""

    def draw(slot, shown, shot):
        return np.full((32, 48, 3), shot.pose[2, 3], dtype=np.float32)

    return Film(lambda shot: (scene, 0), draw, "pinhole", (32, 48))


def test_each_frame_of_a_film_shows_the_path_at_its_time(scene: Scene, tmp_path: Path) -> None:
    shots = follow_path(PATH, 8.0, scene, None)
    file = tmp_path / "film.mp4"
    write_film(file, make_film(scene), shots, 8.0)
    with av.open(str(file)) as video:
        decoded = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in video.decode(video=0)]
    assert [round(8 * time) for time, _ in decoded] == list(range(9))
    for shot, (_, image) in zip(shots, decoded, strict=True):
        assert np.abs(image - 255 * shot.pose[2, 3]).max() <= 3
    assert [shot.vertical_fov_degrees for shot in shots[:: len(shots) - 1]] == [75.0, 60.0]


def test_a_film_of_a_flight_has_at_least_two_frames() -> None:
    poses = []
    shots = list_flight(lambda at: poses.append(at) or np.eye(4), 24.0, 75.0, 0.01)
    assert len(shots) == 2 and poses == [0, 1]
    assert len(list_flight(lambda at: np.eye(4), 24.0, 75.0)) == 96
