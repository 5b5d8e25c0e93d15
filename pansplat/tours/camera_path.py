"""Camera paths through key frames, and their JSON files.

A file is an object with `key_frames`, a list of objects in the order of time:

    {"key_frames": [{"seconds": 0, "position": [0, 0, 0], "direction": [0, 0, 1], "vertical_fov_degrees": 75}, ...]}

`position` is in the user's unit, `direction` is where the camera looks (of any length), both in axes of the user's
world. The camera has no roll relative to the scene's up direction. `vertical_fov_degrees` is optional (75).
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy
import torch
from jaxtyping import Float
from msgspec import Meta, Struct, structs
from torch import Tensor

from pansplat.constants import MAX_FOV_DEGREES, MIN_FOV_DEGREES
from pansplat.errors import InputError
from pansplat.geometry.level import turn_axes
from pansplat.system.atomic import replacing
from pansplat.system.strict_json import read_json
from pansplat.tours.graph import TourGraph
from pansplat.tours.route import find_angles

MAX_SECONDS = 3600.0

_Coordinate = Annotated[float, Meta(ge=-1e9, le=1e9)]
Vector = tuple[_Coordinate, _Coordinate, _Coordinate]


class KeyFrame(Struct, frozen=True, forbid_unknown_fields=True):
    """A camera at a time, as in files."""

    seconds: Annotated[float, Meta(ge=0, le=MAX_SECONDS)]  # time since the start of the path
    position: Vector  # place in the world of a scene; in a file, in the user's world
    direction: Vector  # where the camera looks
    vertical_fov_degrees: Annotated[float, Meta(ge=MIN_FOV_DEGREES, le=MAX_FOV_DEGREES)] = 75.0


@dataclass(frozen=True)
class CameraPath:
    """Key frames in the order of time, and the smooth path through them.

    Position, heading, pitch and field of view are monotone cubics of time between the key frames (PCHIP), so that the
    camera overshoots none of them. Between key frames of two parts of a tour the camera stands still, and jumps at the
    later one.
    """

    key_frames: tuple[KeyFrame, ...] = ()

    def __len__(self) -> int:
        return len(self.key_frames)

    @property
    def seconds(self) -> float:
        """Time of the last key frame."""
        return self.key_frames[-1].seconds if self.key_frames else 0.0

    def count_frames(self, fps: float) -> int:
        """Number of frames of a film: from time 0 to the last key frame, both included."""
        return math.floor(self.seconds * fps + 1e-6) + 1

    def interpolate(
        self, seconds: float, level: Float[np.ndarray, "3 3"], tour: TourGraph | None = None
    ) -> tuple[Float[np.ndarray, "4 4"], float]:
        """Pose and vertical field of view, degrees, at a time; before the first and after the last key frame the camera
        stands still.

        Args:
            seconds: time.
            level: axes of a level camera (columns right, down, forward).
            tour: that the path is in.
        """
        frames = self.key_frames if tour is None else self._select_part(seconds, tour)
        times = np.array([frame.seconds for frame in frames])
        yaws, pitches = zip(*(_find_angles(frame, level) for frame in frames), strict=True)
        places, fovs = [frame.position for frame in frames], [frame.vertical_fov_degrees for frame in frames]
        values = np.column_stack((places, np.unwrap(yaws), pitches, fovs))
        at = min(max(seconds, times[0]), times[-1])
        value = values[0] if len(frames) == 1 else scipy.interpolate.PchipInterpolator(times, values)(at)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn_axes(level, float(value[3]), float(value[4])), value[:3]
        return pose, float(value[5])

    def _select_part(self, seconds: float, tour: TourGraph) -> tuple[KeyFrame, ...]:
        """The key frames in a row of one part of a tour, among which is the last one at a time."""
        parts = [tour.parts[tour.find_nearest_edge(np.array(frame.position))[0][0]] for frame in self.key_frames]
        runs = [list(run) for _, run in itertools.groupby(range(len(parts)), key=parts.__getitem__)]
        begun = [run for run in runs if self.key_frames[run[0]].seconds <= seconds] or runs[:1]
        return tuple(self.key_frames[number] for number in begun[-1])

    def add(self, frame: KeyFrame) -> CameraPath:
        """The path with a further key frame; one at the same time is replaced."""
        others = [other for other in self.key_frames if other.seconds != frame.seconds]
        return CameraPath(tuple(sorted((*others, frame), key=lambda other: other.seconds)))

    def map_places(self, move: Callable[[Tensor], Tensor]) -> CameraPath:
        """The path with other positions, as by `WorldFrame.localize_places` and back."""
        places = (tuple(move(torch.tensor(frame.position, dtype=torch.float64)).tolist()) for frame in self.key_frames)
        moved = (structs.replace(frame, position=place) for frame, place in zip(self.key_frames, places, strict=True))
        return CameraPath(tuple(moved))

    def remove(self, index: int) -> CameraPath:
        """The path without one key frame."""
        return CameraPath(self.key_frames[:index] + self.key_frames[index + 1 :])


def _find_angles(frame: KeyFrame, level: Float[np.ndarray, "3 3"]) -> tuple[float, float]:
    """Yaw and pitch of the direction of a key frame; the yaw of a vertical one is 0."""
    direction = level.T @ np.array(frame.direction) / np.linalg.norm(frame.direction)
    return find_angles(np.round(direction, 12) + 0.0)


class _File(Struct, forbid_unknown_fields=True):
    """The content of a file."""

    key_frames: list[KeyFrame] = []
    software: str = ""


def read_path(file: Path) -> CameraPath:
    """The path of a JSON file."""
    frames = read_json(file, _File).key_frames
    if not frames:
        raise InputError(f'{file}: needed one or more "key_frames", got none; add them.')
    for number, frame in enumerate(frames):
        if math.hypot(*frame.direction) < 1e-6:
            raise InputError(f'{file}, key_frames[{number}]: needed a "direction" with a length, got 0; correct it.')
    for number, (before, after) in enumerate(itertools.pairwise(frames), start=1):
        if after.seconds <= before.seconds:
            raise InputError(
                f'{file}, key_frames[{number}]: needed "seconds" after {before.seconds:g}, got {after.seconds:g}; '
                "sort the key frames by time."
            )
    return CameraPath(tuple(frames))


def write_path(path: CameraPath, file: Path) -> None:
    """Write a path to a JSON file, which appears complete or not at all."""
    rows = (json.dumps(structs.asdict(frame)) for frame in path.key_frames)
    text = "[\n  " + ",\n  ".join(rows) + "\n]"
    with replacing(file) as unfinished:
        unfinished.write_text(f'{{"software": "pansplat", "key_frames": {text}}}\n', "utf-8")
