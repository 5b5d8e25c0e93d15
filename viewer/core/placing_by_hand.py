"""Placing a panorama by hand on the floor plan of others: dragging, turning, walls that snap, saving and undoing.

Needs neither imgui nor OpenGL: the window draws what is here and passes the pointer's movements in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pansplat.errors import InputError
from pansplat.geometry.level import wrap_angle
from pansplat.inputs.panorama_sets import Panorama
from pansplat.poses.edit import PoseEditor
from pansplat.poses.placing import Piece, PlanFrame, PlanPose, find_wall_yaw, read_piece
from pansplat_viewer.core.background import BackgroundWorker, Report
from pansplat_viewer.core.loader import SceneEntry, list_panoramas_of_folder

if TYPE_CHECKING:
    from pansplat_viewer.window.input import Input

WALL_ANGLE = math.radians(6)  # walls within this angle become parallel
_APART = 0.3  # distance of a panorama without a known place from a door or the others, metres
_PLAN_MARGIN, _LEAST_EXTENT = 0.6, 4.0  # margin around what a plan shows, and its least side, metres

Nodes = tuple[int, ...]


class PlacingByHand:
    """The panoramas of a folder, and the one that is being placed.

    Attributes:
        panoramas: with the poses that were last loaded.
        problem: why poses cannot be changed; None if they can.
        node: the panorama that is being placed; None if none is.
        targets: the panoramas that it is placed beside.
        floor: the plan of `targets`.
        place: where `node` is on the plan; None until its depth is estimated.
        pieces: what panoramas show; None for one that cannot be read.
        error: a message of the last failure; the viewer takes it.
    """

    def __init__(
        self, folder: Path, panoramas: Sequence[Panorama], *, read: Callable[[Path], Piece] | None = None
    ) -> None:
        """No panorama is being placed.

        Args:
            folder: of the panoramas.
            panoramas: all of them, in their own worlds.
            read: makes the piece of a panorama, by default from its estimated depth; called in a worker thread.
        """
        self._folder, self._read, self.panoramas = folder, read or read_piece, tuple(panoramas)
        self.problem: str | None = None
        self._editor: PoseEditor | None = None
        try:
            self._editor = PoseEditor(folder, panoramas)
        except InputError as error:
            self.problem = str(error)
        self.pieces: dict[Path, Piece | None] = {}
        self._worker: BackgroundWorker[None] = BackgroundWorker("piece-reader")
        self.node: int | None = None
        self.targets: Nodes = ()
        self._anchor = 0  # the one of `targets` that the first place is relative to
        self._world: int | None = None  # number of the world of `targets`; None if they have no pose
        self.floor = PlanFrame(np.eye(3), 1.0)
        self.place: PlanPose | None = None
        self._is_changed = False  # whether the poses of `panoramas` are older than the file
        self.error: str | None = None

    @staticmethod
    def open(
        before: PlacingByHand | None, entry: SceneEntry | None, entries: Sequence[SceneEntry]
    ) -> PlacingByHand | None:
        """The panoramas of the folder of an entry, those of `before` if they are the same; None without any.

        Args:
            before: what was opened before; closed if it is not returned.
            entry: the scene that is shown or loaded.
            entries: all that were found at its path.
        """
        source = None if entry is None or entry.merged is not None else entry.tour or entry.pair
        if before is not None:
            if source is not None and source.folder == before._folder and before.reopen(entries):
                return before
            before.close()
        panoramas = [] if source is None else list_panoramas_of_folder(entries, source.folder)
        return PlacingByHand(source.folder, panoramas) if source is not None and panoramas else None

    def reopen(self, entries: Sequence[SceneEntry]) -> bool:
        """Take the poses of panoramas that were loaded again; returns False if they are others, or had no poses before.

        Changes before can still be undone.
        """
        panoramas = tuple(list_panoramas_of_folder(entries, self._folder))
        if self._editor is None or [view.image for view in panoramas] != [view.image for view in self.panoramas]:
            return False
        self.panoramas, self._is_changed = panoramas, False
        if self.node is not None and self.targets not in self.list_targets(self.node):
            self.stop()
        return True

    # --- what is placed, and beside which others ---

    @property
    def is_listed(self) -> bool:
        """Whether a panorama states how its pose was found, so that the panel lists them all."""
        return any(view.placement.source is not None for view in self.panoramas)

    def _is_placed(self, node: int) -> bool:
        return self.panoramas[node].placement.state != "not placed"

    def group_of(self, node: int) -> Nodes:
        """The panoramas that have a pose with one, and itself."""
        if not self._is_placed(node):
            return (node,)
        nodes, world = range(len(self.panoramas)), self.panoramas[node].world
        return tuple(other for other in nodes if self._is_placed(other) and self.panoramas[other].world == world)

    def list_targets(self, node: int) -> list[Nodes]:
        """The groups that a panorama can be placed beside, the most likely one first.

        That is its own without it, or the one of its approximate place, then the largest one.
        """
        own, about = self.group_of(node), self.panoramas[node].placement.about
        groups = {self.group_of(other) for other in range(len(self.panoramas)) if other not in own}
        found = sorted(groups, key=lambda group: (-len(group), group))
        if about is not None:
            found.sort(key=lambda group: all(self._image(other) != about.beside for other in group))
        rest = tuple(other for other in own if other != node)
        return [rest, *found] if rest else found

    @property
    def moved(self) -> Nodes:
        """The panoramas that are moved, that which is placed first; its group moves with it to another group."""
        assert self.node is not None
        own = self.group_of(self.node)
        is_inside = not set(own).isdisjoint(self.targets)
        return (self.node, *(() if is_inside else (other for other in own if other != self.node)))

    def start(self, node: int, targets: Nodes | None = None) -> None:
        """Place a panorama beside others; `targets` are one of `list_targets`, by default the first."""
        options = self.list_targets(node)
        if self._editor is None or not options or self._is_changed:
            changed = "needed the changed poses, which are being loaded; wait, or reload the folder."
            self.error = self.problem or (changed if options else "needed another photograph to place one beside it.")
            return
        self.targets = targets or options[0]
        about = self.panoramas[node].placement.about
        beside = [other for other in self.targets if about is not None and self._image(other) == about.beside]
        linked = [other for other in self.targets if self._list_links(other, node)]
        self._anchor = (*beside, *linked, *self.targets)[0]
        first = self.panoramas[self._anchor]
        self._world = first.world if self._is_placed(self._anchor) else None
        try:
            unit = None if self._world is None else self._editor.read_unit(self._world)
        except InputError as error:
            self.error = str(error)
            return
        self.floor, self.node, self.place = self._find_frame(self.targets, unit or first.camera_height), node, None
        self._start_reading()
        self.update()

    def _find_frame(self, group: Nodes, unit: float) -> PlanFrame:
        """The plan of a group; panoramas without a pose are upright."""
        if not self._is_placed(group[0]):
            return PlanFrame(np.eye(3), unit)
        return PlanFrame.of_world(np.stack([self._get_pose(node) for node in group]), unit)

    def apply(self, events: Input) -> Input:
        """The input; Escape closes the window in which a panorama is placed, and nothing else then."""
        if self.node is None or "escape" not in events.pressed:
            return events
        self.stop()
        return replace(events, pressed=events.pressed - {"escape"})

    def stop(self) -> None:
        """End placing; the panorama stays where it was saved."""
        self.node = None
        self._worker.cancel()

    def close(self) -> None:
        """Wait for the thread."""
        self._worker.close()

    # --- what panoramas show ---

    @property
    def progress(self) -> str | None:
        """What is being read; None if nothing is."""
        return None if self._worker.progress is None else self._worker.progress[0]

    def _image(self, node: int) -> Path:
        return self.panoramas[node].image

    def _upright(self, node: int) -> Float[np.ndarray, "3 3"]:
        piece = self.pieces.get(self._image(node))
        return np.eye(3) if piece is None else piece.upright

    def _get_pose(self, node: int) -> Float[np.ndarray, "4 4"]:
        """The pose; a panorama without one is upright at the origin."""
        if self._is_placed(node):
            return self.panoramas[node].cam2world.double().numpy()
        pose = np.eye(4)
        pose[:3, :3] = self._upright(node).T
        return pose

    def _start_reading(self) -> None:
        """Estimate the depth of what is not read yet: first of what the first place depends on."""
        assert self.node is not None
        needed, placed = dict.fromkeys((self.node, self._anchor, *self.targets, *self.moved)), self._image(self.node)
        wanted = [image for image in map(self._image, needed) if self.pieces.get(image) is None]

        def work(report: Report) -> None:
            for number, image in enumerate(wanted):
                report(f"estimating depth: {len(wanted) - number} photographs to go", number / len(wanted))
                try:
                    self.pieces[image] = self._read(image)
                except InputError:
                    if image == placed:
                        raise
                    self.pieces[image] = None

        if wanted:
            self._worker.start(work)

    def update(self) -> None:
        """Take what was read since the last call."""
        failure = self._worker.poll()
        if isinstance(failure, BaseException):
            self.error, self.node = f"a photograph cannot be placed: {failure}", None
        is_known = self.node is not None and all(self._image(n) in self.pieces for n in (self.node, self._anchor))
        if is_known and self.place is None:
            self.place = self._choose_place()

    # --- the place ---

    def _choose_place(self) -> PlanPose:
        """The first place: the pose if there is one here, the approximate place, behind a door, or beside all."""
        assert self.node is not None
        if self._is_inside:
            return self.floor.find_place(self._get_pose(self.node), self._upright(self.node))
        about, anchor = self.panoramas[self.node].placement.about, self.find_place(self._anchor)
        if about is not None and about.beside == self._image(self._anchor):
            unit = self.floor.unit if about.is_in_heights else 1.0
            return anchor.add(PlanPose(about.right, about.forward, about.yaw), unit)
        if doors := self._find_doors(self._anchor, self.node):
            edge, ahead = doors[0], doors[0] - anchor[:2]
            ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        else:  # to the right of all
            outline, right = self.outline(self._anchor), max(self.find_place(target).right for target in self.targets)
            right = right if outline is None else max(right, outline[:, 0].max())
            edge, ahead = np.array((right, anchor.forward)), np.array((1.0, 0.0))
        yaw = self._align(0.0, math.inf)
        room = self._draw(self.node, PlanPose(0.0, 0.0, yaw))
        assert room is not None
        right, forward = (edge + (_APART - (room @ ahead).min()) * ahead).tolist()
        return PlanPose(right, forward, yaw)

    @property
    def _is_inside(self) -> bool:
        """Whether the panorama has a pose in the world of the plan."""
        assert self.node is not None
        return self._is_placed(self.node) and self.panoramas[self.node].world == self._world

    def move(self, right: float, forward: float) -> None:
        """Move the panorama by metres on the plan."""
        if self.place is not None:
            self.place = self.place._replace(right=self.place.right + right, forward=self.place.forward + forward)

    def turn(self, angle: float) -> None:
        """Turn the panorama to the right by an angle, radians, without snapping."""
        if self.place is not None:
            self.place = self.place._replace(yaw=wrap_angle(self.place.yaw + angle))

    def turn_to(self, yaw: float) -> None:
        """Turn the panorama to a heading, radians; walls that are nearly parallel to those of the plan become so."""
        if self.place is not None:
            self.place = self.place._replace(yaw=self._align(yaw, WALL_ANGLE))

    def _align(self, yaw: float, largest: float) -> float:
        error = self._find_wall_error(yaw)
        return wrap_angle(yaw if error is None or abs(error) > largest else yaw - error)

    def _find_wall_error(self, yaw: float) -> float | None:
        """The angle from walls of the plan to those of the panorama at a heading; None if either are not known."""
        assert self.node is not None
        yaws, piece = [], self.pieces.get(self._image(self.node))
        for target in self.targets:
            other = self.pieces.get(self._image(target))
            if other is not None and other.wall_yaw is not None:
                yaws.append(self.find_place(target).yaw + other.wall_yaw)
        walls = find_wall_yaw(yaws)
        if piece is None or piece.wall_yaw is None or walls is None:
            return None
        return math.remainder(yaw + piece.wall_yaw - walls, math.pi / 2)

    @property
    def is_aligned(self) -> bool:
        """Whether the walls are parallel to those of the plan."""
        error = None if self.place is None else self._find_wall_error(self.place.yaw)
        return error is not None and abs(error) < 1e-6

    def find_place(self, node: int) -> PlanPose:
        """Where a panorama is on the plan."""
        is_moved = self.place is not None and node in self.moved
        return self.floor.find_place(self.find_poses()[node] if is_moved else self._get_pose(node), self._upright(node))

    def outline(self, node: int) -> Float[np.ndarray, "azimuth 2"] | None:
        """The floor outline of a panorama on the plan, metres (right, forward); None before it is known."""
        return self._draw(node, self.find_place(node))

    def _draw(self, node: int, place: PlanPose) -> Float[np.ndarray, "azimuth 2"] | None:
        piece = self.pieces.get(self._image(node))
        return None if piece is None else piece.draw_outline(place, self.floor.unit)

    def find_poses(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The poses, cam2world, of what is moved.

        A panorama that has a pose is moved along the floor and turned; it keeps its tilt, and in its own world its
        height. Another one is upright, as high as the nearest camera.
        """
        assert self.node is not None and self.place is not None
        before, place, level = self._get_pose(self.node), self.place, np.eye(3)
        if self._is_inside:
            frame, beside = self.floor, self.node
        else:
            frame = self._find_frame(self.group_of(self.node), self.floor.unit)
            beside = min(self.targets, key=lambda target: place.distance(self.find_place(target)))
        old = frame.make_pose(frame.find_place(before, self._upright(self.node)), level, _measure_down(frame, before))
        new = self.floor.make_pose(place, level, _measure_down(self.floor, self._get_pose(beside)))
        return {node: new @ np.linalg.inv(old) @ self._get_pose(node) for node in self.moved}

    def _list_links(self, start: int, end: int) -> list[float]:
        """The yaws of the links of a panorama to another one."""
        return [link.yaw for link in self.panoramas[start].links if link.target == self.panoramas[end].name]

    def _find_doors(self, start: int, end: int) -> list[Float[np.ndarray, "2"]]:
        """Where the links of a panorama to another one meet its outline, which is by azimuth."""
        outline, yaws = self.outline(start), self._list_links(start, end)
        return [] if outline is None else [outline[int(yaw / math.tau % 1 * len(outline))] for yaw in yaws]

    def find_doors(self) -> list[Float[np.ndarray, "2"]]:
        """The doors to which links between the panorama and the others lead, as both show them."""
        assert self.node is not None and self.place is not None
        pairs = [pair for target in self.targets for pair in ((target, self.node), (self.node, target))]
        return [door for pair in pairs for door in self._find_doors(*pair)]

    # --- the file ---

    @property
    def can_undo(self) -> bool:
        """Whether a change since the scene was opened is left to undo."""
        return self._editor is not None and self._editor.can_undo

    def save(self) -> bool:
        """Write the pose, and end placing; returns whether it was written."""
        if self.place is None:
            self.error = "needed the depth of the photograph to place it; wait until it is estimated."
            return False
        poses = {self._image(node): pose for node, pose in self.find_poses().items()}
        if self._world is None:
            poses |= {self._image(target): self._get_pose(target) for target in self.targets}
        return self._change(lambda editor: editor.place(poses, self._world, self.floor.unit))

    def undo(self) -> bool:
        """Undo the last change of the file, and end placing; returns whether it was undone."""
        return self._change(PoseEditor.undo)

    def _change(self, change: Callable[[PoseEditor], None]) -> bool:
        assert self._editor is not None
        try:
            change(self._editor)
        except InputError as error:
            self.error = str(error)
            return False
        self._is_changed = True
        self.stop()
        return True


def _measure_down(frame: PlanFrame, pose: Float[np.ndarray, "4 4"]) -> float:
    """Where a camera is along the down axis of a plan, metres."""
    return float(frame.level[:, 1] @ pose[:3, 3])


@dataclass(frozen=True)
class PlanView:
    """The part of a floor plan in a rectangle of the screen; forward is up.

    Attributes:
        middle: of the rectangle, metres (right, forward).
        pixels_per_metre: scale.
        size: of the rectangle, pixels.
        corner: of the rectangle on the screen, pixels.
    """

    middle: tuple[float, float]
    pixels_per_metre: float
    size: tuple[float, float]
    corner: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def of_points(
        points: Float[np.ndarray, "n 2"], size: tuple[float, float], corner: tuple[float, float] = (0.0, 0.0)
    ) -> PlanView:
        """The view of points with a margin, at least 4 m wide."""
        low, high = points.min(axis=0), points.max(axis=0)
        extent = np.maximum(high - low + 2 * _PLAN_MARGIN, _LEAST_EXTENT)
        right, forward = ((low + high) / 2).tolist()
        return PlanView((right, forward), float(np.min(np.array(size) / extent)), size, corner)

    def to_pixels(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels (right, down) of places on the screen."""
        scale = self.pixels_per_metre
        return (np.asarray(places) - self.middle) * (scale, -scale) + np.array(self.size) / 2 + self.corner

    def contains(self, points: Float[np.ndarray, "n 2"]) -> bool:
        """Whether points are inside."""
        pixels = self.to_pixels(points) - self.corner
        return bool(((pixels >= 0) & (pixels <= self.size)).all())
