"""Panoramas as pieces on a floor plan: their places, what snaps, and how well a place fits the panoramas around it.

A piece is a panorama with its estimated depth. Its place is a point on the plan and a heading, because gravity is known
and cameras of a tour are equally high. Units of a plan are metres; those of a piece are camera heights.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array

from pansplat.geometry.equirect import pixel_directions
from pansplat.geometry.path import level_pose, up_direction, wrap_angle
from pansplat.images.image_files import read_height, read_panorama
from pansplat.inputs.pairs import Link, Panorama
from pansplat.poses.axes import SceneAxes, find_axes
from pansplat.poses.dense import Comparison, Surroundings, compare
from pansplat.poses.depth import estimate_depth
from pansplat.poses.two_view import RelativePose
from pansplat.tours.floor import find_ceiling, trace_floor

DEPTH_HEIGHT = 384  # rows of the panorama whose depth is estimated
_IMAGE_HEIGHT = 1024  # largest one, in which edges are looked for
_OUTLINE_STEP = 2  # of the pixels that an outline is traced from, rows and columns
_UPRIGHT = math.radians(8)  # between a world's y axis and the mean down of its cameras, if y is down
SNAP_RADIUS, SNAP_ANGLE = 0.35, math.radians(12)  # metres and radians, to a suggestion
WALL_ANGLE = math.radians(6)  # to parallel walls
POOR_FIT = 0.25  # quality below which a place is doubtful
_LEAST_OVERLAP = 0.01  # of a comparison that counts
_LIKENESS, _CONFLICT_WEIGHT = (0.05, 0.4), 5.0  # by chance, and at right poses of neighbours in zind (docs/poses.md)
_LINK_REACH = 1.0, 4.0  # camera heights, of a place by a link
_DOOR = math.radians(16)  # standard deviation of what counts in the direction of a door
_LINTEL = 0.6, 0.95  # what is above doors and below the ceiling, fractions of the ceiling's height over the camera
_WALL_TURN, _GRAZING = math.radians(25), 0.12  # of a surface and its wall; least cosine of a direction and a wall's
_LEAST_WALL, _THICKNESS = 0.25, 0.08  # distance of a wall with a door, and its thickness, camera heights
_ALIKE, _NO_DOOR = 7.65, 0.1  # weight of the likeness, as in the check of poses; weight of no common door
_MOST_SUGGESTIONS = 4  # of a pair
_NEIGHBOURS = 4  # nearest panoramas that a place is compared with


class PlanPose(NamedTuple):
    """The pose of a camera on a floor plan, or relative to another one.

    Attributes:
        right, forward: metres; of a `Suggestion` heights of the camera (`add` has its unit).
        yaw: heading, radians to the right of the plan's forward axis.
    """

    right: float
    forward: float
    yaw: float

    def add(self, other: PlanPose, unit: float = 1.0) -> PlanPose:
        """A place that is known relative to this one, in a unit of metres."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        right, forward = unit * other.right, unit * other.forward
        return PlanPose(
            self.right + cosine * right + sine * forward,
            self.forward - sine * right + cosine * forward,
            wrap_angle(self.yaw + other.yaw),
        )

    def inverse(self) -> PlanPose:
        """The place of the plan's origin relative to this one."""
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        right, forward = sine * self.forward - cosine * self.right, -sine * self.right - cosine * self.forward
        return PlanPose(right, forward, -self.yaw)

    def distance(self, other: PlanPose) -> float:
        """Between the cameras, in the unit of both."""
        return math.hypot(self.right - other.right, self.forward - other.forward)

    def turn_between(self, other: PlanPose) -> float:
        """Absolute difference of the headings, radians."""
        return abs(wrap_angle(self.yaw - other.yaw))


class Suggestion(NamedTuple):
    """A place of one panorama relative to another one, camera heights, with the logarithm of its odds."""

    place: PlanPose
    log_odds: float


def list_suggestions(
    relation: RelativePose, upright: tuple[Float[Array, "3 3"], Float[Array, "3 3"]]
) -> tuple[Suggestion, ...]:
    """The best hypotheses of a pair as places of the second panorama relative to the first one.

    Args:
        relation: of the pair.
        upright: axes of both upright cameras in the cameras' frames, as columns (`DepthMap.rotation`).
    """
    found, poses = [], relation.hypotheses
    for n in np.argsort(-poses.log_odds, kind="stable")[:_MOST_SUGGESTIONS]:
        if poses.log_odds[n] > -math.inf:
            centre = upright[0].T @ (-poses.rotations[n].T @ poses.translations[n])
            forward = upright[0].T @ poses.rotations[n].T @ upright[1][:, 2]
            place = PlanPose(float(centre[0]), float(centre[2]), math.atan2(forward[0], forward[2]))
            found.append(Suggestion(place, float(poses.log_odds[n])))
    return tuple(found)


def suggest_by_links(
    first: Panorama, second: Panorama, upright: tuple[Float[Array, "3 3"], Float[Array, "3 3"]]
) -> PlanPose | None:
    """The place of the second panorama relative to the first one by the links of a tour, camera heights.

    It is where a link meets the floor, 1 to 4 camera heights away. A link back states the heading. Without it the start
    view looks onwards; without a start view, the middle of the picture. None without links.

    Args:
        first, second: names and links count.
        upright: axes of both upright cameras in the cameras' frames, as columns (`DepthMap.rotation`).
    """
    there, back = _find_link(first, second), _find_link(second, first)
    if there is None:
        turned = None if back is None else suggest_by_links(second, first, (upright[1], upright[0]))
        return None if turned is None else turned.inverse()
    yaw, distance = _meet_floor(there.yaw, there.pitch, upright[0])
    if back is not None:
        heading = yaw + math.pi - _meet_floor(back.yaw, back.pitch, upright[1])[0]
    else:
        heading = yaw - (_meet_floor(*second.start, upright[1])[0] if second.start else 0.0)
    return PlanPose(distance * math.sin(yaw), distance * math.cos(yaw), wrap_angle(heading))


class Guess(NamedTuple):
    """A place of one panorama relative to another one, camera heights, with its probability."""

    place: PlanPose
    probability: float


def suggest_through_door(first: Panorama, second: Panorama, pieces: tuple[Piece, Piece]) -> PlanPose | None:
    """The place of the second panorama relative to the first one if their links lead to one door, camera heights.

    It is the most probable one of `list_through_door`. None without links of both, or without walls.

    Args:
        first, second: names and links count.
        pieces: of both.
    """
    there, back = _find_link(first, second), _find_link(second, first)
    if there is None or back is None:
        return None
    guesses = list_through_door(pieces, ((there.yaw, there.pitch), (back.yaw, back.pitch)))
    return max(guesses, key=lambda guess: guess.probability).place if guesses else None


def list_through_door(
    pieces: tuple[Piece, Piece], links: tuple[tuple[float, float], tuple[float, float]]
) -> list[Guess]:
    """Places of the second piece relative to the first one if a direction in each leads to one door.

    There is one for each wall of both that the door may be in. It is the more probable, the more surfaces around the
    door are parallel to these walls, and the more alike is what both see.

    Args:
        links: yaw and pitch of both directions, as of a `Link`.
    """
    doors = [piece.find_doors(_meet_floor(*link, piece.upright)[0]) for piece, link in zip(pieces, links, strict=True)]
    frame, found = PlanFrame(pieces[0].upright, 1.0), []
    for (there, share), (back, other) in itertools.product(*doors):
        right, forward = _THICKNESS * math.sin(there.yaw), _THICKNESS * math.cos(there.yaw)
        behind = PlanPose(there.right + right, there.forward + forward, wrap_angle(there.yaw + math.pi - back.yaw))
        place = behind.add(PlanPose(-back.right, -back.forward, 0.0))
        pose = frame.make_pose(place, pieces[1].upright, 0.0)
        rotation, translation = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        seen = compare(pieces[0].surroundings, pieces[1].surroundings, rotation, translation)
        found.append((place, share * other * math.exp(_ALIKE * seen.weight * seen.likeness)))
    total = _NO_DOOR + sum(weight for _, weight in found)
    return [Guess(place, weight / total) for place, weight in found]


def _find_link(start: Panorama, end: Panorama) -> Link | None:
    return next((link for link in start.links if link.target == end.name), None)


def _meet_floor(yaw: float, pitch: float, upright: Float[Array, "3 3"]) -> tuple[float, float]:
    """Yaw of a direction of a camera for the upright camera, and the level distance to where it meets the floor."""
    level = math.cos(pitch)
    right, down, forward = upright.T @ (level * math.sin(yaw), math.sin(pitch), level * math.cos(yaw))
    distance = math.hypot(right, forward) / down if down > 0 else math.inf
    return math.atan2(right, forward), min(max(distance, _LINK_REACH[0]), _LINK_REACH[1])


@dataclass(frozen=True, eq=False)
class Piece:
    """What one panorama shows, in camera heights.

    Attributes:
        surroundings: grey values and depth.
        wall_yaw: direction of its walls, radians to the right of the upright camera's z axis, up to a quarter turn;
            None if it shows no walls.
    """

    surroundings: Surroundings
    wall_yaw: float | None

    @property
    def upright(self) -> Float[Array, "3 3"]:
        """Axes of the upright camera in the camera's frame, as columns."""
        return self.surroundings.depth.rotation

    @functools.cached_property
    def outline(self) -> Float[Array, "azimuth 2"] | None:
        """Where its floor ends (right, forward of the upright camera); None if it shows no floor."""
        depth = self.surroundings.depth.log_depth
        rays = pixel_directions(*depth.shape).numpy()
        places = (rays * np.exp(depth)[..., None])[::_OUTLINE_STEP, ::_OUTLINE_STEP].reshape(-1, 3)
        found = trace_floor(places.astype(np.float64))
        return None if found is None else found[0] / found[1]

    @functools.cached_property
    def _lintels(self) -> tuple[Float[Array, "n 2"], Float[Array, "n"]] | None:
        """Places (right, forward) of walls above doors, and yaws of their normals, away from the camera."""
        depth = self.surroundings.depth.log_depth
        places = pixel_directions(*depth.shape).numpy() * np.exp(depth)[..., None]
        across, along = (np.roll(places, -2, axis=axis) - np.roll(places, 2, axis=axis) for axis in (1, 0))
        normals = np.cross(across, along)
        normals *= np.sign((normals * places).sum(axis=-1, keepdims=True))
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
        places, normals = (values[::2, ::2].reshape(-1, 3) for values in (places, normals))
        ceiling = find_ceiling(places)
        if ceiling is None:
            return None
        heights = -places[:, 1] / ceiling
        chosen = (heights > _LINTEL[0]) & (heights < _LINTEL[1]) & (np.abs(normals[:, 1]) < 0.35)
        return places[chosen][:, (0, 2)], np.arctan2(normals[chosen, 0], normals[chosen, 2])

    def find_doors(self, yaw: float) -> list[tuple[PlanPose, float]]:
        """For each wall that a direction may meet: where, with the yaw of the wall's normal; and the share of the
        surfaces around the direction, above doors, that are parallel to it."""
        if self._lintels is None:
            return []
        places, normals = self._lintels
        wall_yaw = find_wall_yaw(normals.tolist()) if self.wall_yaw is None else self.wall_yaw
        if wall_yaw is None:
            return []
        turns = np.angle(np.exp(1j * (np.arctan2(*places.T) - yaw)))
        weights = np.exp(-0.5 * (turns / _DOOR) ** 2)
        found = []
        for normal in wall_yaw + math.pi / 2 * np.arange(4):
            cosine = math.cos(yaw - normal)
            own = (np.abs(np.angle(np.exp(1j * (normals - normal)))) < _WALL_TURN) & (np.abs(turns) < 3 * _DOOR)
            if cosine > _GRAZING and own.any():
                offsets = places[own] @ (math.sin(normal), math.cos(normal))
                order = offsets.argsort(kind="stable")
                sums = weights[own][order].cumsum()
                reach = offsets[order][np.searchsorted(sums, 0.5 * sums[-1])] / cosine
                if reach * cosine > _LEAST_WALL:
                    place = PlanPose(reach * math.sin(yaw), reach * math.cos(yaw), wrap_angle(float(normal)))
                    found.append((place, float(sums[-1])))
        total = sum(weight for _, weight in found)
        return [(place, weight / total) for place, weight in found]

    def draw_outline(self, place: PlanPose, unit: float) -> Float[Array, "azimuth 2"]:
        """The outline on the plan, metres; a small circle if there is none."""
        outline = self.outline
        if outline is None:
            angles = np.linspace(0, 2 * math.pi, 24, endpoint=False)
            outline = 0.3 * np.stack((np.sin(angles), np.cos(angles)), axis=1)
        cosine, sine = math.cos(place.yaw), math.sin(place.yaw)
        turned = outline @ np.array(((cosine, -sine), (sine, cosine)))
        return np.array((place.right, place.forward)) + unit * turned


def read_piece(image: Path) -> Piece:
    """The piece of a panorama file, with its depth by the default model."""
    pixels = read_panorama(image, min(read_height(image), _IMAGE_HEIGHT))[0].permute(1, 2, 0).numpy()
    grey = cv2.cvtColor((pixels * 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
    axes = find_axes(grey)
    pixels = cv2.resize(pixels, (2 * DEPTH_HEIGHT, DEPTH_HEIGHT), interpolation=cv2.INTER_AREA)
    return make_piece(Surroundings(pixels, estimate_depth(pixels, axes.axes[0] if axes.has_down else None)), axes)


def make_piece(surroundings: Surroundings, axes: SceneAxes) -> Piece:
    """The piece of a panorama whose depth and axes are estimated."""
    wall = surroundings.depth.rotation.T @ axes.axes[1]
    return Piece(surroundings, math.atan2(wall[0], wall[2]) if axes.has_walls else None)


@dataclass(frozen=True, eq=False)
class PlanFrame:
    """The axes and the unit of a floor plan in a world.

    Attributes:
        level: right, down and forward of the plan in the world, as columns.
        unit: metres that are one camera height of the pieces.
    """

    level: Float[Array, "3 3"]
    unit: float

    @staticmethod
    def of_world(poses: Float[Array, "view 4 4"], unit: float) -> PlanFrame:
        """The plan of posed cameras; it looks along the first one. y is down if the cameras agree with that."""
        matrices = torch.from_numpy(np.asarray(poses, np.float64))
        up = up_direction(matrices)
        if float(-up[1]) > math.cos(_UPRIGHT):
            up = torch.tensor((0.0, -1.0, 0.0), dtype=torch.float64)
        return PlanFrame(level_pose(matrices[0], up)[:3, :3].numpy(), unit)

    def find_place(self, pose: Float[Array, "4 4"], upright: Float[Array, "3 3"]) -> PlanPose:
        """The place of a camera."""
        right, _, forward = (self.level.T @ pose[:3, 3]).tolist()
        ahead = self.level.T @ pose[:3, :3] @ upright[:, 2]
        return PlanPose(right, forward, math.atan2(ahead[0], ahead[2]))

    def make_pose(self, place: PlanPose, upright: Float[Array, "3 3"], down: float) -> Float[Array, "4 4"]:
        """The pose, cam2world, of an upright camera at a place; `down` is its place along that axis, metres."""
        cosine, sine = math.cos(place.yaw), math.sin(place.yaw)
        pose = np.eye(4)
        turn = np.array(((cosine, 0, sine), (0, 1, 0), (-sine, 0, cosine)))
        pose[:3, :3] = self.level @ turn @ upright.T
        pose[:3, 3] = self.level @ (place.right, down, place.forward)
        return pose


class Snapped(NamedTuple):
    """A place after snapping.

    Attributes:
        suggestion: number of the suggestion that it is at; None for none.
        is_aligned: whether only its walls were turned parallel to the plan's.
    """

    place: PlanPose
    suggestion: int | None = None
    is_aligned: bool = False


def snap(
    place: PlanPose, suggestions: Sequence[PlanPose], wall_yaw: float | None = None, target_yaw: float | None = None
) -> Snapped:
    """The nearest suggestion within reach, or else the place with its walls parallel to those of the plan.

    Args:
        place: of the piece.
        suggestions: on the plan.
        wall_yaw: of the piece (`Piece.wall_yaw`); None snaps no walls.
        target_yaw: of the plan's walls, radians up to a quarter turn.
    """
    near = [
        (place.distance(other) / SNAP_RADIUS + place.turn_between(other) / SNAP_ANGLE, number)
        for number, other in enumerate(suggestions)
        if place.distance(other) < SNAP_RADIUS and place.turn_between(other) < SNAP_ANGLE
    ]
    if near:
        number = min(near)[1]
        return Snapped(suggestions[number], number)
    if wall_yaw is not None and target_yaw is not None:
        error = math.remainder(place.yaw + wall_yaw - target_yaw, math.pi / 2)
        if abs(error) < WALL_ANGLE:
            return Snapped(place._replace(yaw=wrap_angle(place.yaw - error)), None, True)
    return Snapped(place)


def find_wall_yaw(yaws: Sequence[float]) -> float | None:
    """The mean of directions up to quarter turns, radians; None if there are none or they contradict each other."""
    if not yaws:
        return None
    mean = np.exp(4j * np.array(yaws)).mean()
    return float(np.angle(mean)) / 4 if abs(mean) > 0.5 else None


@dataclass(frozen=True)
class Fit:
    """How well a piece at a place fits the panoramas around it.

    Attributes:
        likeness: correlation of the detail of what both see; mean over the panoramas, by overlap.
        conflict: share of the sphere whose surface is where another camera sees through; likewise.
        overlap: largest share of the sphere that both see.
    """

    likeness: float
    conflict: float
    overlap: float

    @property
    def score(self) -> float:
        """About 0 by chance, and 1 at a right pose in one room."""
        low, high = _LIKENESS
        return (self.likeness - low) / (high - low) - _CONFLICT_WEIGHT * self.conflict

    @property
    def quality(self) -> float:
        """The score within 0 to 1."""
        return min(max(self.score, 0.0), 1.0)


def measure_fit(
    piece: Piece,
    pose: Float[Array, "4 4"],
    others: Sequence[tuple[Piece, Float[Array, "4 4"]]],
    unit: float,
) -> Fit | None:
    """The fit of a piece at a pose with the nearest other panoramas; None if it has nothing in common with them.

    Args:
        piece: of the panorama.
        pose: its cam2world.
        others: pieces and poses of panoramas of the same world.
        unit: metres that are one camera height.
    """
    nearest = sorted(others, key=lambda other: float(np.linalg.norm(other[1][:3, 3] - pose[:3, 3])))[:_NEIGHBOURS]
    found: list[Comparison] = []
    for other, known in nearest:
        rotation = pose[:3, :3].T @ known[:3, :3]
        translation = pose[:3, :3].T @ (known[:3, 3] - pose[:3, 3]) / unit
        found.append(compare(other.surroundings, piece.surroundings, rotation, translation))
    weights = np.array([comparison.overlap for comparison in found])
    if not len(found) or weights.max() < _LEAST_OVERLAP:
        return None
    likeness, conflict = (np.array([getattr(c, name) for c in found]) for name in ("likeness", "conflict"))
    return Fit(
        float((weights * likeness).sum() / weights.sum()),
        float((weights * conflict).sum() / weights.sum()),
        float(weights.max()),
    )
