"""Films: the frames of paths and flights in files, and photographs: where they are shown, how they fade, what masks
hide."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from synthetic_scenes import make_balls, place_cameras, see_box

from pansplat.export.film import Film, FilmPhotographs, follow_path, list_frames, plan_visits, write_film
from pansplat.gaussians.scene import Gaussians, Scene, SceneTour
from pansplat.geometry.equirect import pixel_directions
from pansplat.inputs.panorama_sets import Panorama, PanoramaSet
from pansplat.rendering.image_planes import image_planes
from pansplat.tours.camera_path import CameraPath, KeyFrame
from pansplat.tours.facts import TourFacts

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
    for right, expected in ((0.0, 1.0), (0.03, 1.0), (0.13, 0.5), (0.23, 0.0), (0.5, 0.0)):
        pose = move(0, right)
        index, weight = stops.find_stop(pose)
        assert index == 0 and weight == pytest.approx(expected)
        image = stops.cover(index, weight, pose, PLANE, lambda: drawn.append(1) or GAUSSIANS)
        assert (len(drawn) > 0) == (weight < 1), "a whole photograph needs no Gaussians"
        along = directions(pose) - GAUSSIANS
        mixed = ((image - GAUSSIANS) * along).sum() / (along**2).sum()
        assert mixed == pytest.approx(weight, abs=0.02)
    assert FilmPhotographs((), POSES).find_stop(pose) == (None, 0.0)


def test_what_masks_hide_shows_the_gaussians(photographs: list[PanoramaSet]) -> None:
    pose = move(1, 0.0)
    image = FilmPhotographs(photographs, POSES).cover(1, 0.75, pose, PLANE, lambda: GAUSSIANS)
    photograph = directions(pose)
    height = 1 - 2 * photograph[..., 1]  # sine of the elevation of each pixel
    for chosen, shown in ((height > 0, GAUSSIANS), (height < -0.1, photograph)):
        assert chosen.sum() > 200
        assert np.abs(image - (0.25 * GAUSSIANS + 0.75 * shown))[chosen].max() < 0.01


def test_exposures_become_that_of_the_gaussians(photographs: list[PanoramaSet]) -> None:
    pose = move(0, 0.0)
    stops = FilmPhotographs(photographs, POSES, ((1.25, 1.0, 2.0), (1.0, 1.0, 1.0)))
    image = stops.cover(0, 1.0, pose, PLANE, lambda: GAUSSIANS)
    assert np.abs(image - directions(pose) / (1.25, 1.0, 2.0)).max() < 0.01


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


def test_a_film_of_two_panoramas_moves_as_that_of_a_tour(scene: Scene) -> None:
    route = plan_visits(TourFacts(scene))
    kinds = [step.kind for step in route.steps]
    assert kinds == ["rest", "flight", "rest"] and route.walk == (0, 1)
    shots = list_frames(route, 24.0, 75.0)
    assert len(shots) == round(24 * route.seconds) and shots[-1].moment.photograph == 1
    assert [shot.seconds for shot in list_frames(route, 24.0, 75.0, 0.01)] == [0, route.seconds], "two frames at least"


def test_a_film_zooms_along_a_poor_edge_and_flies_along_others() -> None:
    """The third panorama shows the room nearer and lighter."""
    poses = place_cameras((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    views = []
    for view, (center, factor, shade) in enumerate(zip(poses[:, :3, 3], (1, 1, 0.6), (0.5, 0.5, 0.9), strict=True)):
        seen = see_box(torch.tensor((-3.0, -1.0, -3.0)), torch.tensor((5.0, 1.5, 3.0)), center, 5000)
        means, color = center + factor * (seen - center), torch.full_like(seen, shade)
        views.append(make_balls(means, 0.02, 1.0, color=color, views=view))
    tour = SceneTour(((0, 1, 1.0), (1, 2, 1.0)))
    facts = TourFacts(Scene(Gaussians.cat(views), poses, 0.45, 10.0, tour=tour))
    assert facts.graph.poor == ((1, 2),) and facts.graph.clearances.keys() == {0, 1, 2}
    steps = {step.nodes: step.kind for step in plan_visits(facts).steps if step.nodes[0] != step.nodes[1]}
    assert steps == {(0, 1): "flight", (1, 2): "zoom"}
