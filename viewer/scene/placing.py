"""Photographs and their poses: which are placed, rejecting and restoring, and placing one by hand on a floor plan.

Needs neither imgui nor OpenGL: the panel draws what is here and passes the pointer's movements in metres.
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
from pansplat.geometry.path import wrap_angle
from pansplat.inputs.folder_formats import read_pose_file
from pansplat.inputs.pairs import Panorama
from pansplat.poses.edit import PoseEditor
from pansplat.poses.placing import (
    POOR_FIT,
    Fit,
    Piece,
    PlanFrame,
    PlanPose,
    Snapped,
    Suggestion,
    find_wall_yaw,
    measure_fit,
    read_piece,
    snap,
    suggest_by_links,
    suggest_through_door,
)
from pansplat_viewer.scene.background import BackgroundWorker, CancelledError, Report
from pansplat_viewer.scene.loader import SceneEntry, list_panoramas

if TYPE_CHECKING:
    from pansplat_viewer.window.input import Input

TURN_STEP = math.radians(5)
_ADJUST_STEP, _LEAST_STEP = 0.16, 0.01  # metres: first and last step of an adjustment
_ADJUST_TURN = math.radians(20)  # turn for a step of a metre
FINE = 0.1  # of movements and turns with Shift
_TURN_SNAP = 0.45  # of a step: a turn by steps must leave what it snapped to
_MAX_GHOSTS = 12
_SAME_METRES, _SAME_ANGLE = 0.25, math.radians(6)  # of suggestions that count as one
_PLAN_MARGIN, _LEAST_EXTENT = 0.6, 4.0  # metres, around what a plan shows, and of its sides
_BESIDE = 2.0  # metres, of a piece without suggestions from the others

Nodes = tuple[int, ...]


@dataclass(frozen=True)
class Ghost:
    """A hypothesis of the pose estimate, or of the links of a tour, as a place on the plan.

    Attributes:
        log_odds: logarithm of the odds that it is right; -inf for one by links, whose odds are not known.
        other: the photograph that it is relative to.
    """

    place: PlanPose
    log_odds: float
    other: int

    @property
    def probability(self) -> float:
        """The probability that the hypothesis is right."""
        return 1 / (1 + math.exp(-min(max(self.log_odds, -50), 50)))


class Placing:
    """The photographs of a folder, and the one that is being placed.

    Attributes:
        panoramas: with their present poses and placements; those of the scene that is shown may be older.
        problem: why poses cannot be changed; None if they can.
        node: the photograph that is being placed; None if none is.
        with_group: whether the other photographs of its group move with it.
        targets: the photographs that it is placed beside.
        floor: the plan of `targets`.
        places: on the plan, of `targets` and of `node`'s group before.
        ghosts: suggested places, most probable first.
        shown: the place of the piece, after snapping.
        fit: at this place; None if it has nothing in common with the others, or before it is known.
        is_changed: whether poses were changed since the scene was loaded.
        error: a message of the last change that failed; the panel takes it.
    """

    def __init__(
        self, folder: Path, panoramas: Sequence[Panorama], *, read: Callable[[Path], Piece] | None = None
    ) -> None:
        """No photograph is being placed.

        Args:
            folder: of the photographs.
            panoramas: all of them, in their own worlds.
            read: makes the piece of a photograph, by default from its estimated depth; called in a worker thread.
        """
        self._folder, self._read, self._first = folder, read or read_piece, tuple(panoramas)
        self.panoramas = self._first
        self.problem: str | None = None
        self._editor: PoseEditor | None = None
        try:
            self._editor = PoseEditor(folder, panoramas)
        except InputError as error:
            self.problem = str(error)
        self.pieces: dict[Path, Piece] = {}
        self._failed: dict[Path, str] = {}
        self._worker: BackgroundWorker[None] = BackgroundWorker("piece-reader")
        self._suggestions: dict[tuple[Path, Path], tuple[Suggestion, ...]] = {}
        self.node: int | None = None
        self.with_group, self.targets = False, ()
        self._world: int | None = None
        self.floor = PlanFrame(np.eye(3), 1.0)
        self.places: dict[int, PlanPose] = {}
        self.ghosts: list[Ghost] = []
        self._raw = PlanPose(0, 0, 0)
        self.shown = Snapped(self._raw)
        self.fit: Fit | None = None
        self._measured: tuple[object, ...] = ()
        self._doubted: PlanPose | None = None  # a place of a poor fit that `save` has not written yet
        self._is_moved = False
        self._step = 0.0  # metres, of the adjustment in progress
        self.is_changed = False
        self.error: str | None = None

    @staticmethod
    def open(before: Placing | None, entry: SceneEntry, entries: Sequence[SceneEntry]) -> Placing | None:
        """The photographs of the folder of an entry, those of `before` if they are the same; None without any.

        Args:
            before: what was opened before; closed if it is not returned.
            entry: the scene that is shown.
            entries: all that were found at its path.
        """
        source = entry.tour or entry.pair
        panoramas = [] if source is None or entry.merged is not None else list_panoramas(entries, source.folder)
        if before is not None:
            if source is not None and before.is_of(source.folder, panoramas):
                before.reopen(panoramas)
                return before
            before.close()
        return Placing(source.folder, panoramas) if source is not None and panoramas else None

    def is_of(self, folder: Path, panoramas: Sequence[Panorama]) -> bool:
        """Whether these are its photographs."""
        return folder == self._folder and [view.image for view in panoramas] == [view.image for view in self._first]

    def reopen(self, panoramas: Sequence[Panorama]) -> None:
        """Go on with the same photographs, which were loaded again; changes before can still be undone."""
        self.is_changed = False
        if self._editor is None or not self._editor.file.exists():
            self._first = tuple(panoramas)
        try:
            self._read_again()
        except InputError as error:
            self.error = str(error)

    # --- photographs ---

    @property
    def is_listed(self) -> bool:
        """Whether a photograph states how its pose was found, so that the panel lists them all."""
        return any(view.placement.source is not None for view in self.panoramas)

    @property
    def can_undo(self) -> bool:
        """Whether a change since the scene was opened is left to undo."""
        return self._editor is not None and self._editor.can_undo

    def can_reject(self, node: int) -> bool:
        """Whether the pose of a photograph may be rejected: it is probable, or was placed by hand."""
        return self.problem is None and self.panoramas[node].placement.state in ("probable", "by hand")

    def can_restore(self, node: int) -> bool:
        """Whether a rejection of a photograph may be taken back."""
        return self.problem is None and self.panoramas[node].placement.is_rejected

    def reject(self, node: int) -> None:
        """Drop the pose of a photograph, in the file."""
        self._change(lambda editor: editor.reject(self.panoramas[node].image))

    def restore(self, node: int) -> None:
        """Take back the rejection of a photograph."""
        self._change(lambda editor: editor.restore(self.panoramas[node].image))

    def undo(self) -> None:
        """Undo the last change of the file."""
        self._change(lambda editor: editor.undo())

    def _change(self, change: Callable[[PoseEditor], None]) -> bool:
        """Change the file, and read it again; returns whether it was changed."""
        if self._editor is None:
            self.error = self.problem
            return False
        try:
            change(self._editor)
            self._read_again()
        except InputError as error:
            self.error = str(error)
            return False
        self.is_changed = True
        if self.node is not None:
            self.start(self.node)
        return True

    def _read_again(self) -> None:
        """Take poses and placements from the poses.json, or as at first if there is none."""
        found = {panorama.image.resolve(): panorama for panorama in self._first}
        if self._editor is not None and self._editor.file.exists():
            collection = read_pose_file(self._editor.file, self._folder)
            found |= {view.image.resolve(): view for view in collection.views}
        self.panoramas = tuple(
            replace(
                view,
                cam2world=found[view.image.resolve()].cam2world,
                world=found[view.image.resolve()].world,
                placement=found[view.image.resolve()].placement,
            )
            for view in self._first
        )

    # --- what is placed, and beside which others ---

    def group_of(self, node: int) -> Nodes:
        """The photographs that have a pose with one, and itself."""
        view = self.panoramas[node]
        if view.placement.state == "not placed":
            return (node,)
        return tuple(
            other
            for other, panorama in enumerate(self.panoramas)
            if panorama.world == view.world and panorama.placement.state != "not placed"
        )

    def list_targets(self, node: int) -> list[Nodes]:
        """The groups that a photograph can be placed beside: its own without it, then the largest first."""
        own = self.group_of(node)
        groups = {self.group_of(other) for other in range(len(self.panoramas)) if other not in own}
        others = sorted(groups, key=lambda group: (-len(group), group))
        rest = tuple(other for other in own if other != node)
        return [rest, *others] if rest else others

    def start(self, node: int, targets: Nodes | None = None, *, with_group: bool = False) -> None:
        """Place a photograph beside others.

        Args:
            node: the photograph.
            targets: one of `list_targets`; None for the first one.
            with_group: whether the others of its group move with it, to another group.
        """
        options = self.list_targets(node)
        own = self.group_of(node)
        if with_group:
            options = [option for option in options if not set(option) & set(own)]
        if self._editor is None or not options:
            self.error = self.problem or "needed another photograph to place one beside it, got none."
            return
        self.node, self.with_group = node, with_group
        self.targets = targets if targets in options else options[0]
        first = self.panoramas[self.targets[0]]
        has_poses = first.placement.state != "not placed"
        self._world = first.world if has_poses else None
        try:
            unit = self._editor.read_unit(first.world) if has_poses else None
            self._suggestions = self._editor.read_suggestions()
        except InputError as error:
            self.error, self.node = str(error), None
            return
        poses = np.stack([self._get_pose(target) for target in self.targets])
        self.floor = PlanFrame.of_world(poses, unit or first.camera_height)
        self.places, self.ghosts, self.fit, self._measured, self._is_moved = {}, [], None, (), False
        self._step, self._doubted = 0.0, None
        self._start_reading()
        self.update()

    def apply(self, events: Input) -> Input:
        """The input; Escape closes the window in which a photograph is placed, and nothing else then."""
        if self.node is None or "escape" not in events.pressed:
            return events
        self.stop()
        return replace(events, pressed=events.pressed - {"escape"})

    def stop(self) -> None:
        """End placing; the photograph stays where it was saved."""
        self.node = None
        self._worker.cancel()

    def close(self) -> None:
        """Wait for the thread."""
        self._worker.close()

    @property
    def moved(self) -> Nodes:
        """The photographs of the piece, that which is placed first."""
        assert self.node is not None
        rest = [other for other in self.group_of(self.node) if other != self.node] if self.with_group else []
        return (self.node, *rest)

    @property
    def is_reading(self) -> bool:
        """Whether pieces are still to come."""
        return self._worker.future is not None

    @property
    def is_busy(self) -> bool:
        """Whether the next `update` changes something without input."""
        return self.is_reading or self.is_adjusting

    @property
    def missing(self) -> int:
        """Number of pieces that are still to come."""
        nodes = (*self.moved, *self.targets)
        return sum(self._get_piece(node) is None and self._image(node) not in self._failed for node in nodes)

    def _image(self, node: int) -> Path:
        return self.panoramas[node].image

    def _get_piece(self, node: int) -> Piece | None:
        return self.pieces.get(self._image(node))

    def _get_pose(self, node: int) -> Float[np.ndarray, "4 4"]:
        """The pose; a photograph without one is upright at the origin."""
        if self.panoramas[node].placement.state != "not placed":
            return self.panoramas[node].cam2world.double().numpy()
        piece, pose = self._get_piece(node), np.eye(4)
        if piece is not None:
            pose[:3, :3] = piece.upright.T
        return pose

    def _start_reading(self) -> None:
        wanted = [self._image(node) for node in (*self.moved, *self.targets)]
        wanted = [image for image in wanted if image not in self.pieces and image not in self._failed]

        def work(report: Report) -> None:
            for number, image in enumerate(wanted):
                report(f"estimating the depth of {image.name}", number / len(wanted))
                try:
                    self.pieces[image] = self._read(image)
                except InputError as error:
                    self._failed[image] = str(error)

        if wanted:
            self._worker.start(work)

    # --- the piece ---

    def update(self) -> None:
        """Take the pieces that were read since the last call, and measure the fit of a new place."""
        failure = self._worker.poll()
        if isinstance(failure, BaseException) and not isinstance(failure, CancelledError):
            self.error = f"the depth cannot be estimated: {failure}"
        if self.node is None or self._get_piece(self.node) is None:
            if self.node is not None and self._image(self.node) in self._failed:
                self.error, self.node = self._failed[self._image(self.node)], None
            return
        known = [target for target in self.targets if self._get_piece(target) is not None]
        fresh = [target for target in known if target not in self.places]
        for target in fresh:
            piece = self.pieces[self._image(target)]
            self.places[target] = self.floor.find_place(self._get_pose(target), piece.upright)
        if fresh or not self._measured:
            self.ghosts = self._list_ghosts()
            if not self._is_moved:
                self.shown = self._choose_start()
                self.drop()
        if not known:
            return
        key = self._make_key(known)
        if key != self._measured:
            self._measured = key
            self.fit = self._measure(known, self.shown.place)
        if self._step:
            self._adjust(known)

    def adjust(self) -> None:
        """Move the piece to the place of the best fit nearby, in small steps with each `update`."""
        self._step = _ADJUST_STEP if self.fit is not None else 0.0

    @property
    def is_adjusting(self) -> bool:
        """Whether the piece moves to the best fit."""
        return self._step > 0

    def _adjust(self, known: Sequence[int]) -> None:
        """One step of a search along the axes: the best neighbour, or half the step."""
        place, best = self.shown.place, self.fit
        steps = np.concatenate((np.eye(3), -np.eye(3))) * (1, 1, _ADJUST_TURN) * self._step
        for right, forward, turn in steps.tolist():
            near = PlanPose(place.right + right, place.forward + forward, wrap_angle(place.yaw + turn))
            fit = self._measure(known, near)
            if fit is not None and (best is None or fit.score > best.score):
                best, self.shown = fit, Snapped(near)
        if self.shown.place == place:
            self._step = self._step / 2 if self._step > _LEAST_STEP else 0.0
        self.fit, self._is_moved = best, True
        self._measured = self._make_key(known)
        self.drop()

    def _make_key(self, known: Sequence[int]) -> tuple[object, ...]:
        return self.shown.place, len(known), self.node, self.targets

    def _list_ghosts(self) -> list[Ghost]:
        assert self.node is not None
        image, found = self._image(self.node), []
        for target, place in self.places.items():
            other = self._image(target)
            for ends, is_reversed in (((other, image), False), ((image, other), True)):
                for suggestion in self._suggestions.get(ends, ()):
                    relative = suggestion.place.inverse() if is_reversed else suggestion.place
                    found.append(Ghost(place.add(relative, self.floor.unit), suggestion.log_odds, target))
            ends, pieces = (self.panoramas[target], self.panoramas[self.node]), (self.pieces[other], self.pieces[image])
            upright = pieces[0].upright, pieces[1].upright
            for linked in (suggest_through_door(*ends, pieces), suggest_by_links(*ends, upright)):
                if linked is not None:
                    found.append(Ghost(place.add(linked, self.floor.unit), -math.inf, target))
        kept: list[Ghost] = []
        for ghost in sorted(found, key=lambda ghost: -ghost.log_odds):
            same = [
                other
                for other in kept
                if ghost.place.distance(other.place) < _SAME_METRES
                and ghost.place.turn_between(other.place) < _SAME_ANGLE
            ]
            if not same:
                kept.append(ghost)
        return kept[:_MAX_GHOSTS]

    def _choose_start(self) -> Snapped:
        """Where the piece is at first: its pose if it has one here, the best suggestion, or beside the others."""
        assert self.node is not None
        if self._is_in_world(self.node):
            upright = self.pieces[self._image(self.node)].upright
            return Snapped(self.floor.find_place(self._get_pose(self.node), upright))
        if self.ghosts:
            return Snapped(self.ghosts[0].place, 0)
        right = max((place.right for place in self.places.values()), default=0.0)
        forward = float(np.mean([place.forward for place in self.places.values()])) if self.places else 0.0
        return Snapped(PlanPose(right + _BESIDE, forward, 0.0))

    @property
    def wall_yaw(self) -> float | None:
        """Direction of the walls of the plan, radians up to a quarter turn; None if it is not known."""
        yaws = []
        for target, place in self.places.items():
            own = self.pieces[self._image(target)].wall_yaw
            if own is not None:
                yaws.append(place.yaw + own)
        return find_wall_yaw(yaws)

    def list_points(self) -> Float[np.ndarray, "n 2"]:
        """Points on the plan that a view of it should contain: outlines of the others and the piece, and ghosts."""
        outlines = [self.outline(node) for node in (*self.targets, *(self.moved if self.node is not None else ()))]
        points = [outline for outline in outlines if outline is not None]
        points += [np.array([ghost.place[:2]]) for ghost in self.ghosts]
        return np.concatenate(points) if points else np.zeros((1, 2))

    def move(self, right: float, forward: float, *, fine: bool = False, free: bool = False) -> None:
        """Move the piece by metres on the plan.

        Args:
            right, forward: movement of the pointer.
            fine: a tenth of it, without snapping.
            free: without snapping.
        """
        factor = FINE if fine else 1.0
        raw = self._raw
        self._set(PlanPose(raw.right + factor * right, raw.forward + factor * forward, raw.yaw), free=fine or free)

    def turn(self, steps: float, *, fine: bool = False, free: bool = False) -> None:
        """Turn the piece to the right by steps of 5 degrees, or of half a degree if `fine`; see `move`."""
        self._raw = self.shown.place
        step = TURN_STEP * (FINE if fine else 1.0)
        raw = self._raw._replace(yaw=wrap_angle(self._raw.yaw + steps * step))
        self._set(raw, free=fine or free, largest_turn=_TURN_SNAP * TURN_STEP)

    def turn_to(self, yaw: float, *, free: bool = False) -> None:
        """Turn the piece to a heading, radians; see `move`."""
        self._set(self._raw._replace(yaw=wrap_angle(yaw)), free=free)

    def go_to(self, number: int) -> None:
        """Move the piece to a ghost."""
        self._raw, self._is_moved, self._step = self.ghosts[number].place, True, 0.0
        self.shown = Snapped(self._raw, number)

    def drop(self) -> None:
        """End a drag: the next one starts from where the piece is shown."""
        self._raw = self.shown.place

    def _set(self, raw: PlanPose, *, free: bool, largest_turn: float | None = None) -> None:
        if self.node is None or self._get_piece(self.node) is None:
            return
        self._raw, self._is_moved, self._step = raw, True, 0.0
        walls = None if free else self.pieces[self._image(self.node)].wall_yaw
        found = snap(raw, [] if free else [ghost.place for ghost in self.ghosts], walls, self.wall_yaw)
        if largest_turn is not None and found.place.turn_between(raw) > largest_turn:
            found = Snapped(raw)
        self.shown = found

    def outline(self, node: int) -> Float[np.ndarray, "azimuth 2"] | None:
        """The floor outline of a photograph on the plan, metres (right, forward); None before it is known."""
        piece = self._get_piece(node)
        if piece is None or self.node is None or self._get_piece(self.node) is None or not self.places:
            return None
        if node == self.node:
            place = self.shown.place
        elif node in self.moved:
            place = self.floor.find_place(self.find_poses()[node], piece.upright)
        else:
            place = self.places.get(node)
        return None if place is None else piece.draw_outline(place, self.floor.unit)

    def _find_down(self, place: PlanPose) -> float:
        """The height of the nearest placed camera, along the plan's down axis, metres."""
        nearest = min(self.places, key=lambda target: place.distance(self.places[target]))
        return float(self.floor.level[:, 1] @ self._get_pose(nearest)[:3, 3])

    def _is_in_world(self, node: int) -> bool:
        """Whether a photograph has a pose in the world of the plan."""
        view = self.panoramas[node]
        return view.placement.state != "not placed" and view.world == self._world

    def find_poses(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The poses, cam2world, of the piece's photographs where it is shown.

        A photograph that has a pose is moved along the floor and turned; it keeps its tilt, and in its own world its
        height. Another one is upright, as high as the nearest camera.
        """
        return self._find_poses(self.shown.place)

    def _find_poses(self, place: PlanPose) -> dict[int, Float[np.ndarray, "4 4"]]:
        assert self.node is not None
        upright = self.pieces[self._image(self.node)].upright
        pose = self.floor.make_pose(place, upright, self._find_down(place))
        if self.panoramas[self.node].placement.state == "not placed":
            return {self.node: pose}
        old, is_inside = self._get_pose(self.node), self._is_in_world(self.node)
        others = np.stack([self._get_pose(other) for other in self.group_of(self.node)])
        level = self.floor.level if is_inside else PlanFrame.of_world(others, self.floor.unit).level
        before = PlanFrame(level, self.floor.unit).find_place(old, upright)
        down = float(level[:, 1] @ old[:3, 3]) if is_inside else self._find_down(place)
        motion, turn = np.eye(4), place.yaw - before.yaw
        cosine, sine = math.cos(turn), math.sin(turn)
        motion[:3, :3] = self.floor.level @ np.array(((cosine, 0, sine), (0, 1, 0), (-sine, 0, cosine))) @ level.T
        motion[:3, 3] = self.floor.level @ (place.right, down, place.forward) - motion[:3, :3] @ old[:3, 3]
        return {node: motion @ self._get_pose(node) for node in self.moved}

    def _measure(self, known: Sequence[int], place: PlanPose) -> Fit | None:
        assert self.node is not None
        others = [(self.pieces[self._image(target)], self._get_pose(target)) for target in known]
        piece = self.pieces[self._image(self.node)]
        return measure_fit(piece, self._find_poses(place)[self.node], others, self.floor.unit)

    @property
    def is_doubted(self) -> bool:
        """Whether the next `save` writes a place that fits poorly."""
        return self._doubted == self.shown.place

    def save(self) -> bool:
        """Write the pose of the piece; returns whether it was written. A poor fit is written by a second call."""
        if self.node is None or not self.places or self._get_piece(self.node) is None:
            self.error = "needed the depth of the photographs to place one of them; wait until it is estimated."
            return False
        self.update()  # the fit at this place
        if (self.fit is None or self.fit.quality < POOR_FIT) and not self.is_doubted:
            self._doubted = self.shown.place
            return False
        poses = {self._image(node): pose for node, pose in self.find_poses().items()}
        if self._world is None:
            poses |= {self._image(target): self._get_pose(target) for target in self.targets}
        world, unit = self._world, self.floor.unit
        return self._change(lambda editor: editor.place(poses, world, unit))


@dataclass(frozen=True)
class PlanView:
    """The part of a floor plan in a rectangle of the screen; forward is up.

    Attributes:
        middle: of the rectangle, metres (right, forward).
        pixels_per_metre: scale.
        size: of the rectangle, pixels.
    """

    middle: tuple[float, float]
    pixels_per_metre: float
    size: tuple[float, float]

    @staticmethod
    def of_points(points: Float[np.ndarray, "n 2"], size: tuple[float, float]) -> PlanView:
        """The view of points with a margin, at least 4 m wide."""
        low, high = points.min(axis=0), points.max(axis=0)
        extent = np.maximum(high - low + 2 * _PLAN_MARGIN, _LEAST_EXTENT)
        right, forward = ((low + high) / 2).tolist()
        return PlanView((right, forward), float(np.min(np.array(size) / extent)), size)

    def to_pixels(self, places: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Pixels (right, down) from the rectangle's corner."""
        scale = self.pixels_per_metre
        return (np.asarray(places) - self.middle) * (scale, -scale) + np.array(self.size) / 2

    def contains(self, points: Float[np.ndarray, "n 2"]) -> bool:
        """Whether points are inside."""
        pixels = self.to_pixels(points)
        return bool(((pixels >= 0) & (pixels <= self.size)).all())
