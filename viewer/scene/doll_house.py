"""The doll's house view of the viewer: its scene, its camera, and the marks of its panoramas.

Imports no OpenGL. `pansplat.tours.doll_house` decides what is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pansplat.gaussians.scene import Scene
from pansplat.tours import Rooms, find_rooms, fit_box, measure_box
from pansplat_viewer.scene.camera import Camera
from pansplat_viewer.scene.tour import Hotspot, make_hotspot

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
        """The rooms of the part and the storey of a panorama; None if nothing of them is known."""
        rooms = find_rooms(scene)
        nodes = rooms.list_level(node)
        gaussians = scene.gaussians
        shown = rooms.find_inside(gaussians) & torch.isin(gaussians.views, torch.tensor(nodes).to(gaussians.views))
        if not shown.any():
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
