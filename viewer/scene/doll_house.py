"""The doll's house view of the viewer: its scene, its camera, the marks of its panoramas, and the ways in and out.

Imports no OpenGL. `pansplat.tours.doll_house` decides what is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from pansplat.gaussians.scene import Scene
from pansplat.tours.doll_house import Rooms, find_rooms, fit_box, measure_box
from pansplat_viewer.scene.background import Jobs, Report
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.state import GLIDE_SECONDS, Glide, ViewerState, leave_doll_house
from pansplat_viewer.scene.tour import Hotspot, TourScenes, make_hotspot

if TYPE_CHECKING:
    from pansplat_viewer.ui.stage import Stage

_JOB = "doll's house"

_PITCH_RADIANS = math.radians(-45)  # of the first view
_FOV_DEGREES = 45.0  # vertical
_LOWEST_RADIANS = math.radians(-8)  # pitch of a camera that looks along the floor
_NEAREST, _FARTHEST = 0.15, 2.0  # of the first distance


@dataclass(frozen=True, eq=False)
class DollHouse:
    """The rooms of some panoramas, to be seen from outside.

    Attributes:
        scene: the Gaussians in the rooms, with all cameras.
        rooms: the rooms.
        nodes: panoramas that are shown, by number.
        labels: of all panoramas.
    """

    scene: Scene
    rooms: Rooms
    nodes: tuple[int, ...]
    labels: Sequence[str]

    @staticmethod
    def make(scene: Scene, labels: Sequence[str], node: int) -> DollHouse | None:
        """The rooms of the part and the storey of a panorama; None if they are not known or not clear."""
        rooms = find_rooms(scene)
        nodes = rooms.list_level(node)
        gaussians = scene.gaussians
        shown = rooms.find_inside(gaussians) & torch.isin(gaussians.views, torch.tensor(nodes).to(gaussians.views))
        if not (shown.any() and rooms.is_clear[node]):
            return None
        joint = replace(scene, gaussians=gaussians.select(shown), overlaps=(), links=(), starts=(), joint=True)
        return DollHouse(joint, rooms, nodes, labels)

    def frame(self, camera: Camera, size: tuple[int, int]) -> Camera:
        """The first camera, which sees all rooms in an image of this size (width, height).

        It keeps its heading, or turns by a right angle if that is nearer to the rooms.
        """
        level = np.asarray(camera.level)
        low, high = measure_box(self.scene.gaussians.means, level)
        tall = math.tan(math.radians(_FOV_DEGREES) / 2)
        kept = replace(camera, pitch_radians=_PITCH_RADIANS, vertical_fov_degrees=_FOV_DEGREES)
        cameras = kept, replace(kept, yaw_radians=kept.yaw_radians + 0.5 * math.pi)
        distances = [fit_box(low, high, level.T @ c.rotation, (tall * size[0] / size[1], tall)) for c in cameras]
        best = int(distances[1] < 0.95 * distances[0])
        turned, distance = cameras[best], distances[best]
        center = level @ ((low + high) / 2)
        position = center - distance * turned.rotation[:, 2]
        return replace(turned, position=tuple(position.tolist()), distance=distance)

    def limit(self, camera: Camera, first: Camera) -> Camera:
        """The camera at a distance and a height from which the rooms are seen, around its orbit centre."""
        center, pitch = camera.orbit_center, min(camera.pitch_radians, _LOWEST_RADIANS)
        distance = min(max(camera.distance, _NEAREST * first.distance), _FARTHEST * first.distance)
        limited = replace(camera, pitch_radians=pitch, distance=distance)
        return replace(limited, position=tuple((center - distance * limited.rotation[:, 2]).tolist()))

    def enter(self, camera: Camera, node: int, inside: Camera) -> Camera:
        """The camera at a panorama, with the heading of a camera outside, else as the one before it went there."""
        position = self.scene.cam2world[node, :3, 3].tolist()
        return replace(inside, position=tuple(position), yaw_radians=camera.yaw_radians, pitch_radians=0.0)

    def find_marks(self, camera: Camera, size: tuple[int, int]) -> list[Hotspot]:
        """The panoramas on their floors, in an image of this size; the nearest last."""
        position, found = np.asarray(camera.position), []
        down = np.asarray(camera.level)[:, 1]
        for node in self.nodes:
            foot = self.scene.cam2world[node, :3, 3].double().numpy() + self.rooms.floors[node] * down
            mark = make_hotspot(camera, size, node, self.labels[node], foot)
            if mark is not None:
                found.append((float(np.linalg.norm(foot - position)), mark))
        return [mark for _, mark in sorted(found, key=lambda item: -item[0])]


class DollHouseView:
    """The doll's house beside the scene: it is made in the background, flown out to, and left.

    Attributes:
        house: what is shown; None inside of the rooms.
    """

    def __init__(self, state: ViewerState, jobs: Jobs, stage: Stage) -> None:
        """The camera is inside."""
        self._state, self._jobs, self._stage = state, jobs, stage
        self.house: DollHouse | None = None
        self._first = self._inside = state.camera  # the first one outside, and the last one inside

    @property
    def is_on(self) -> bool:
        """Whether it is shown or made."""
        return self.house is not None or self._jobs.progress(_JOB) is not None

    def toggle(self, tour: TourScenes | None, labels: Sequence[str]) -> None:
        """Make the doll's house of the part and the storey of the camera, or fly back into it.

        Args:
            tour: that is shown.
            labels: of the panoramas of a scene that is no tour.
        """
        state = self._state
        if self._jobs.cancel(_JOB) or state.glide is not None:
            return
        node = self._find_nearest(tour, state.camera if self.house is None else self._inside)
        if self.house is not None:
            state.target = node
        elif node is None:
            state.show_message("there are no panoramas")
        else:
            if tour is not None:
                labels = [panorama.label for panorama in tour.tour.panoramas]
            scene, gather = self._stage.slot.scene, None if tour is None else tour.gather_part()

            def make(report: Report) -> DollHouse | None:
                gathered = scene if gather is None else gather()
                assert gathered is not None
                report()
                return DollHouse.make(gathered, labels, node)

            self._jobs.start(_JOB, make, self._enter, failure="no doll's house: ")

    def _find_nearest(self, tour: TourScenes | None, camera: Camera) -> int | None:
        """The panorama nearest to a camera, in a tour one of the edge at the camera; None if there is none."""
        if tour is not None:
            return tour.find_nearest(np.asarray(camera.position))
        distances = np.linalg.norm(self._state.context[:, :3, 3] - camera.position, axis=1)
        return int(distances.argmin()) if len(distances) else None

    def _enter(self, house: DollHouse | None) -> None:
        """Show what was made, and fly out of the rooms."""
        state = self._state
        if house is None:
            state.show_message("no doll's house: no surfaces of rooms were found here, or they are too rough")
        elif self._stage.show_outside(house.scene):
            self.house, self._inside = house, state.camera
            self._first = house.frame(state.camera, self._stage.eye_size)
            state.playing = state.path_playing = False
            state.doll_house, state.glide, state.points = True, Glide(state.camera, self._first, is_entry=False), []

    def update(self, seconds: float) -> None:
        """Move the camera outside of the rooms, and back into the panorama that is chosen."""
        state, house = self._state, self.house
        if house is None:
            return
        if state.doll_house and state.target is not None:
            if state.target in house.nodes:
                end = house.enter(state.camera, state.target, self._inside)
                state.glide, state.target = Glide(state.camera, end, is_entry=True), None
            else:  # of another part or storey
                self.leave()
        if state.glide is not None:
            state.glide = replace(state.glide, seconds=state.glide.seconds + seconds)
            state.camera = state.glide.camera
            if state.glide.seconds >= GLIDE_SECONDS:
                if state.glide.is_entry:
                    leave_doll_house(state)
                state.glide = None
        elif state.doll_house:
            state.camera = house.limit(state.camera, self._first)
        if not state.doll_house:
            self._close()

    def leave(self) -> None:
        """Put the camera back where it was inside."""
        if self.house is not None:
            self._state.camera = self._inside
            leave_doll_house(self._state)

    def reset(self) -> None:
        """Show the scene from inside again, and make no doll's house."""
        self._jobs.cancel(_JOB)
        self.leave()
        self._close()

    def _close(self) -> None:
        if self.house is not None:
            self.house = None
            self._stage.hide_outside()
