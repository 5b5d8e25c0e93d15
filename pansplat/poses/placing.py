"""Panoramas as pieces on a floor plan: what each shows, and where it is behind a door of another one.

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
from pansplat.geometry.level import level_pose, turn_axes, up_direction, wrap_angle
from pansplat.images.image_files import read_height, read_panorama
from pansplat.poses.axes import SceneAxes, find_axes
from pansplat.poses.dense import Surroundings, compare
from pansplat.poses.depth import estimate_depth
from pansplat.tours.floor import find_ceiling, find_floor_outline
from pansplat.tours.linked_rooms import WALL_THICKNESS, turn_plan

DEPTH_HEIGHT = 384  # rows of the panorama whose depth is estimated
_IMAGE_HEIGHT = 1024  # rows of the panorama in which edges are looked for, at most
_OUTLINE_STEP = 2  # an outline is traced from every second row and column
_UPRIGHT = math.radians(8)  # y is down in a world whose cameras' mean down is within this angle of it
_DOOR = math.radians(16)  # surfaces around the direction of a door have a normal weight of this deviation
_LINTEL = 0.6, 0.95  # heights above doors and below the ceiling, over that of the ceiling above the camera
_WALL_TURN, _GRAZING = math.radians(25), 0.12  # surfaces of a wall turn less; least cosine of a link and a normal
_LEAST_WALL = 0.25  # least distance of a wall with a door, camera heights
_ALIKE, _NO_DOOR = 7.65, 0.1  # weight of the likeness, as in the check of poses; weight that no door is common


class PlanPose(NamedTuple):
    """The pose of a camera on a floor plan, or relative to another one.

    Attributes:
        right, forward: metres; relative to a camera, its heights (`add` has the unit).
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


class Guess(NamedTuple):
    """A place of one panorama relative to another one, camera heights, with its probability."""

    place: PlanPose
    probability: float


def list_through_door(
    pieces: tuple[Piece, Piece], links: tuple[tuple[float, float], tuple[float, float]]
) -> list[Guess]:
    """Places of the second piece relative to the first one if a direction in each leads to one door.

    There is one for each wall of both that the door may be in. It is the more probable, the more surfaces around the
    door are parallel to these walls, and the more alike is what both see.

    Args:
        links: yaw and pitch of both directions, as of a `Link`.
    """
    doors = [piece.find_doors(_level_yaw(*link, piece.upright)) for piece, link in zip(pieces, links, strict=True)]
    frame, found = PlanFrame(pieces[0].upright, 1.0), []
    for (there, share), (back, other) in itertools.product(*doors):
        right, forward = WALL_THICKNESS * math.sin(there.yaw), WALL_THICKNESS * math.cos(there.yaw)
        behind = PlanPose(there.right + right, there.forward + forward, wrap_angle(there.yaw + math.pi - back.yaw))
        place = behind.add(PlanPose(-back.right, -back.forward, 0.0))
        pose = frame.make_pose(place, pieces[1].upright, 0.0)
        rotation, translation = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        seen = compare(pieces[0].surroundings, pieces[1].surroundings, rotation, translation)
        found.append((place, share * other * math.exp(_ALIKE * seen.weight * seen.likeness)))
    total = _NO_DOOR + sum(weight for _, weight in found)
    return [Guess(place, weight / total) for place, weight in found]


def _level_yaw(yaw: float, pitch: float, upright: Float[Array, "3 3"]) -> float:
    """Yaw of a direction of a camera for the upright camera."""
    level = math.cos(pitch)
    right, _, forward = upright.T @ (level * math.sin(yaw), math.sin(pitch), level * math.cos(yaw))
    return math.atan2(right, forward)


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
        found = find_floor_outline(places.astype(np.float64), np.zeros(2))
        return None if found is None else found.corners / found.camera_height

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
        return np.array(place[:2]) + unit * outline @ turn_plan(place.yaw)


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
        pose = np.eye(4)
        pose[:3, :3] = turn_axes(self.level, place.yaw, 0.0) @ upright.T
        pose[:3, 3] = self.level @ (place.right, down, place.forward)
        return pose


def find_wall_yaw(yaws: Sequence[float]) -> float | None:
    """The mean of directions up to quarter turns, radians; None if there are none or they contradict each other."""
    if not yaws:
        return None
    mean = np.exp(4j * np.array(yaws)).mean()
    return float(np.angle(mean)) / 4 if abs(mean) > 0.5 else None
