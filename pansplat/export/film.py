"""Films: their frames along flights and camera paths, and the one loop that draws and writes them.

The photographs replace the image while the camera stands at a panorama, and in zooms.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from pansplat.export.photographs import list_photographs, load_photograph
from pansplat.gaussians.scene import Scene
from pansplat.geometry.equirect import sample_equirect, uv_from_directions
from pansplat.geometry.level import level_axes
from pansplat.images.panorama_metadata import Stereo
from pansplat.images.video import write_video
from pansplat.inputs.panorama_sets import PanoramaSet
from pansplat.rendering.image_planes import ImagePlane, Layout, image_planes
from pansplat.system.progress import report_progress, stage
from pansplat.tours.camera_path import CameraPath
from pansplat.tours.cross_fade import CrossFade
from pansplat.tours.facts import TourFacts
from pansplat.tours.graph import TourGraph
from pansplat.tours.limits import follow_edge
from pansplat.tours.links import link_parts
from pansplat.tours.merge import select_views
from pansplat.tours.route import REST_SECONDS, STOP_REACH, Moment, Route, find_offset, plan_route
from pansplat.tours.scene_graph import make_graph
from pansplat.tours.scene_views import choose_scene_views
from pansplat.tours.walks import plan_walk

_FADE_METRES = 0.2  # way along which a photograph fades beside a camera path: 0.2 s at a metre a second
_HEIGHTS = (512, 1024, 2048, 4096)  # rows of photographs in memory; the least that is as dense as the frame is read

Image = Float[np.ndarray, "height width 3"]
Pose = Float[np.ndarray, "4 4"]


class FilmPhotographs:
    """Photographs over the frames of a film near their panoramas.

    What masks hide is not shown: the image of the Gaussians stays there.
    """

    def __init__(
        self,
        photographs: Sequence[PanoramaSet],
        cam2world: Float[Tensor, "photograph 4 4"],
        gains: Sequence[tuple[float, ...]] = (),
    ) -> None:
        """Read nothing yet.

        Args:
            photographs: pairs of one panorama each (`list_photographs`); none shows the Gaussians everywhere.
            cam2world: their poses in the world of the film.
            gains: exposures of the photographs over that of the Gaussians, if it is one for all (`Scene.gains`).
        """
        self._poses = cam2world[: len(photographs)].double().cpu()
        self._gains = torch.tensor(gains)[:, :, None, None] if gains else None

        @functools.lru_cache(maxsize=2)
        def load(index: int, height: int) -> Float[Tensor, "4 height width"]:
            image, shown = load_photograph(photographs[index], height)
            image = image if self._gains is None else image / self._gains[index]
            return torch.cat((image.clamp(0, 1), shown[None]))

        self._load = load

    @staticmethod
    def open(source: PanoramaSet | TourGraph, scene: Scene) -> FilmPhotographs:
        """The photographs that a scene, or all scenes of a tour, are predicted from."""
        poses = torch.stack([panorama.cam2world for panorama in source.panoramas])
        gains = scene.gains if scene.joint and len(scene.cam2world) == len(poses) else ()
        return FilmPhotographs(list_photographs(source, range(len(poses))), poses, gains)

    def find_stop(self, pose: Pose) -> tuple[int | None, float]:
        """The photograph at whose panorama a camera is, and its weight, which falls beyond `STOP_REACH`."""
        distances = np.linalg.norm(self._poses[:, :3, 3].numpy() - pose[:3, 3], axis=1)
        if not len(distances):
            return None, 0.0
        nearest = int(distances.argmin())
        return nearest, min(max(1 - (float(distances[nearest]) - STOP_REACH) / _FADE_METRES, 0.0), 1.0)

    def cover(
        self, index: int | None, weight: float, pose: Pose, plane: ImagePlane, draw: Callable[[], Image]
    ) -> Image:
        """The image that `draw` returns, with a weight of a photograph over it, as a camera near it sees it."""
        if weight <= 0 or index is None or index >= len(self._poses):
            return draw()
        photograph, shown = self._draw(index, pose, plane)
        shown = weight * shown
        is_whole = shown.min() > 0.999  # samples are rounded
        return photograph if is_whole else draw() * (1 - shown) + photograph * shown

    def _draw(
        self, index: int, pose: Float[np.ndarray, "4 4"], plane: ImagePlane
    ) -> tuple[Image, Float[np.ndarray, "height width 1"]]:
        """A photograph as a camera near its panorama sees it, and where it is shown (0 to 1)."""
        height = next((height for height in _HEIGHTS if height * plane.pixel_angle >= np.pi), _HEIGHTS[-1])
        rotation = self._poses[index, :3, :3].T @ torch.as_tensor(pose[:3, :3], dtype=torch.float64)
        offset = torch.from_numpy(find_offset(self._poses[index].numpy(), pose[:3, 3]))
        uv = uv_from_directions(plane.directions() @ rotation.T + offset)
        drawn = sample_equirect(self._load(index, height), uv.float()).permute(1, 2, 0).numpy()
        return drawn[..., :3], drawn[..., 3:]


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame of a film.

    Attributes:
        pose: of the camera (cam2world), in the world of the scene.
        vertical_fov_degrees: of a perspective image.
        seconds: time of the frame in the fades.
        moment: of the route that is followed, if it is one.
        goal: of a zoom, the frame that fades in.
    """

    pose: Float[np.ndarray, "4 4"]
    vertical_fov_degrees: float
    seconds: float
    moment: Moment | None = None
    goal: Shot | None = None

    @staticmethod
    def of_moment(moment: Moment, vertical_fov_degrees: float, seconds: float) -> Shot:
        """The frame of a route."""
        goal = None if moment.arrival is None else Shot(moment.arrival, vertical_fov_degrees, seconds)
        fov = moment.narrowing * vertical_fov_degrees
        return Shot(moment.pose, fov, seconds, moment, goal)


def plan_visits(facts: TourFacts) -> Route:
    """A way with a rest at each panorama: through the tour of a scene, or along the cameras of another scene."""
    tour = link_parts(facts.ways)
    walk = plan_walk(tour) if facts.tour.overlaps else range(len(tour))
    return plan_route(tour, walk, rest=REST_SECONDS, outlooks=dict(enumerate(facts.outlooks)))


def list_frames(route: Route, fps: float, vertical_fov_degrees: float, seconds: float | None = None) -> list[Shot]:
    """The frames of a way through panoramas, two or more.

    Args:
        route: the way.
        fps: frames per second.
        vertical_fov_degrees: of each frame.
        seconds: duration, by default that of the route; another one changes the speed of the camera and of the fades.
    """
    fractions = np.linspace(0, 1, max(round((seconds or route.seconds) * fps), 2)).tolist()
    return [Shot.of_moment(route.at(at), vertical_fov_degrees, at * route.seconds) for at in fractions]


def follow_path(path: CameraPath, fps: float, scene: Scene, tour: TourGraph | None) -> list[Shot]:
    """The frames of a camera path in the user's world; frame i shows the path at i / fps seconds.

    Args:
        path: key frames.
        fps: frames per second.
        scene: that is shown.
        tour: that the scene is of.
    """
    local = path.map_places(scene.frame.localize_places)
    level = level_axes(scene.cam2world) if tour is None else tour.level_axes
    times = [number / fps for number in range(path.count_frames(fps))]
    return [Shot(*local.interpolate(time, level, tour), time) for time in times]


def choose_scenes(scene: Scene) -> Callable[[Shot], tuple[Scene, int]]:
    """What the frames of a film show of a scene, and its part: all, or of a tour the scene of the camera's edge."""
    if scene.tour is None:
        return lambda shot: (scene, 0)
    tour, edge = make_graph(scene), None
    select = functools.lru_cache(maxsize=4)(functools.partial(select_views, scene))

    def choose(shot: Shot) -> tuple[Scene, int]:
        nonlocal edge
        place = shot.pose[:3, 3]
        followed = tour.find_nearest_edge(place)[0] if edge is None else follow_edge(tour, place, edge)
        edge = (shot.moment and shot.moment.step.edge) or followed
        part = tour.parts[edge[0]]
        return select(tour.list_parts()[part] if scene.joint else choose_scene_views(tour)[edge]), part

    return choose


class Film:
    """Draws the frames of a film: of one scene, or of the scenes of a tour, which fade into each other."""

    def __init__(
        self,
        choose: Callable[[Shot], tuple[Scene, int]],
        draw: Callable[[int, Scene, Shot], Image],
        layout: Layout,
        size: tuple[int, int],
        photographs: FilmPhotographs | None = None,
    ) -> None:
        """Draw nothing yet.

        Args:
            choose: the scene of a frame, and its part of the tour (`choose_scenes`).
            draw: draws a scene; the number is slot 0 or 1; the two scenes of a fade have different slots.
            layout: of the frames.
            size: (height, width) of the image of one eye, pixels.
            photographs: that are shown at panoramas.
        """
        self._choose, self._draw, self._size = choose, draw, size
        self._layout: Layout = layout
        self._photographs = photographs or FilmPhotographs((), torch.zeros(0, 4, 4))
        self._fade = CrossFade()
        self._has_zoomed = False

    def draw(self, shot: Shot) -> Image:
        """Colour of a frame."""
        scene, part = self._choose(shot)
        moment, goal, fade, photographs = shot.moment, shot.goal, self._fade, self._photographs
        fade.compute_weight(shot.seconds)
        slot = fade.choose_slot(scene)
        if slot is not None:
            fade.show(slot, scene, shot.seconds, part, at_once=self._has_zoomed)
        self._has_zoomed = goal is not None
        fade.move(shot.pose, part)
        weight = fade.compute_weight(shot.seconds)

        drawn = [
            (share, functools.partial(self._draw, slot, scene, replace(shot, pose=pose)))
            for slot, share in ((1 - fade.front, 1 - weight), (fade.front, weight))
            if isinstance(scene := fade.contents[slot], Scene) and (pose := fade.poses[slot]) is not None
            if share > 0 or slot == fade.front
        ]
        photograph = photographs.find_stop(shot.pose) if moment is None else (moment.photograph, moment.weight)
        plane = self._make_plane(shot)
        image = photographs.cover(
            *photograph, shot.pose, plane, lambda: np.sum([share * draw() for share, draw in drawn], axis=0)
        )
        if goal is None or moment is None:
            return image
        arrived = photographs.cover(
            moment.step.nodes[1],
            1.0,
            goal.pose,
            self._make_plane(goal),
            lambda: self._draw(1 - fade.front, self._choose(goal)[0], goal),
        )
        return (1 - moment.arrived) * image + moment.arrived * arrived

    def _make_plane(self, shot: Shot) -> ImagePlane:
        return image_planes(self._layout, self._size, vertical_fov_degrees=shot.vertical_fov_degrees)[0]


@stage()
def write_film(
    file: Path,
    film: Film,
    shots: Sequence[Shot],
    fps: float,
    *,
    panorama: bool = False,
    stereo: Stereo = "mono",
    show: Callable[[int, Image], None] = lambda number, color: None,
) -> None:
    """Write a film (.mp4), completely or not at all.

    Args:
        file: the film.
        film: draws the frames.
        shots: the frames.
        fps: frames per second.
        panorama: whether the frames are panoramas.
        stereo: arrangement of the eyes.
        show: called with the number and the colours of each frame.
    """

    def draw() -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        for number, shot in enumerate(shots):
            report_progress(f"film: frame {number + 1} of {len(shots)}", number / len(shots))
            color = film.draw(shot)
            show(number, color)
            yield (color.clip(0, 1) * 255 + 0.5).astype(np.uint8)

    write_video(file, draw(), fps, panorama=panorama, stereo=stereo)
