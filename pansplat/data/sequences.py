"""Sequences of posed panoramas (360Loc, posed videos), and which of their frames become context and targets."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.data.images import read_mask, resize_panorama
from pansplat.data.layouts import is_loc360_sequence, read_loc360_sequence, trajectory_file
from pansplat.data.pairs import FAR_SEQUENCE, NEAR, Pair, Panorama
from pansplat.data.poses import read_number, read_trajectory
from pansplat.data.video import VideoFile, open_video
from pansplat.data.views import Sample, Views
from pansplat.errors import InputError


@dataclass(frozen=True)
class FramePair:
    """Frame numbers: the two of the context, and the targets."""

    left: int
    right: int
    targets: tuple[int, ...]


@dataclass(frozen=True)
class BoundedSampler:
    """Two frames some frames apart, and targets from the one to the other.

    Attributes:
        min_gap, max_gap: frames from left to right; 2 and 5 for 360Loc, 2 and 30 for Insta360.
        training_gap: "uniform" draws from min_gap to max_gap. "original" is what the original code does: it takes
            min_gap for max_gap on paths that are not circles, so that the gap is always min_gap.
    """

    min_gap: int = 2
    max_gap: int = 5
    training_gap: Literal["uniform", "original"] = "uniform"

    def __post_init__(self) -> None:
        if not 1 <= self.min_gap <= self.max_gap:
            raise InputError(f"needed 1 <= min_gap <= max_gap frames, got {self.min_gap} and {self.max_gap}.")

    def training(self, count: int, generator: np.random.Generator) -> Draw:
        """A random pair of a sequence of `count` frames, and one target between or at them."""
        longest = _longest_gap(count)
        most = min(self.max_gap if self.training_gap == "uniform" else self.min_gap, longest)
        gap = int(generator.integers(min(self.min_gap, most), most, endpoint=True))
        left = int(generator.integers(0, count - gap))
        return FramePair(left, left + gap, (int(generator.integers(left, left + gap, endpoint=True)),))

    def evaluation(self, count: int, draws: int = 100) -> list[FramePair]:
        """Pairs spread evenly over a sequence of `count` frames, each with all frames from left to right."""
        gap = min((self.min_gap + self.max_gap) // 2, _longest_gap(count))
        lefts = [(count - gap - 1) * i // max(draws - 1, 1) for i in range(draws)]
        return [_with_all_between(left, left + gap) for left in lefts]


def _with_all_between(left: int, right: int) -> Draw:
    return FramePair(left, right, tuple(range(left, right + 1)))


def _longest_gap(count: int) -> int:
    if count < 2:
        raise InputError(f"needed a sequence of two or more posed frames, got {count}; leave it out.")
    return count - 1


@runtime_checkable
class FrameSequence(Protocol):
    """A sequence of posed panoramas; `poses` are cam2world in OpenCV axes, metres."""

    @property
    def name(self) -> str: ...

    @property
    def poses(self) -> Sequence[Float[Tensor, "4 4"]]: ...

    def read(self, frames: Sequence[int], height: int) -> Views:
        """Those frames at (height, 2 height), in the order asked for."""
        ...


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """Frames that are picture files. Without a mask file beside a picture the whole picture counts as scene."""

    name: str
    panoramas: tuple[Panorama, ...]
    near: float = NEAR
    far: float = FAR_SEQUENCE

    @property
    def poses(self) -> Sequence[Float[Tensor, "4 4"]]:
        return [panorama.cam2world for panorama in self.panoramas]

    def read(self, frames: Sequence[int], height: int) -> Views:
        """Those frames at (height, 2 height), in the order asked for.

        Raises:
            InputError: a picture, mask or depth file cannot be used.
        """
        chosen = tuple(self.panoramas[frame] for frame in frames)
        first = chosen[0].image
        return Pair(self.name, first.parent, (), chosen, self.near, self.far).load_targets(height)


def read_frame_pair(sequence: FrameSequence, draw: FramePair, height: int) -> Sample:
    """The sample of a draw; each frame is read once, also where a target is an input."""
    frames = sorted({draw.left, draw.right, *draw.targets})
    views = sequence.read(frames, height)
    where = {frame: i for i, frame in enumerate(frames)}
    name = f"{sequence.name}-{draw.left:06d}-{draw.right:06d}"
    return Sample(
        name,
        select_views(views, [where[draw.left], where[draw.right]]),
        select_views(views, [where[frame] for frame in draw.targets]),
    )


def select_views(views: Views, indices: Sequence[int]) -> Views:
    """Some of the views, in the order of `indices`."""
    chosen = torch.tensor(list(indices), dtype=torch.long)
    return Views(
        images=views.images[chosen],
        cam2world=views.cam2world[chosen],
        masks=views.masks[chosen],
        near=views.near,
        far=views.far,
        names=tuple(views.names[i] for i in indices),
        depths=None if views.depths is None else views.depths[chosen],
    )


Stage = Literal["train", "val", "test"]

LOCATIONS: dict[str, tuple[str, ...]] = {
    "train": ("concourse", "hall", "piatrium"),
    "val": ("atrium",),
    "test": ("atrium",),
}


def read_loc360(root: Path | str, stage: Stage) -> list[ImageSequence]:
    """All sequences of the stage's locations, by name; pictures are read when asked for.

    Raises:
        InputError: a location is missing or has no sequence, or a camera_pose.json is wrong.
    """
    root = Path(root).expanduser()
    sequences = []
    for location in LOCATIONS[stage]:
        folders = [
            folder
            for part in ("mapping", "query_360")
            for folder in sorted((root / location / part).glob("*360*"))
            if is_loc360_sequence(folder)
        ]
        if not folders:
            raise InputError(
                f"{root / location}: needed 360Loc sequences (mapping/*360*/camera_pose.json or the same in query_360) "
                f"for {stage}, got none; fetch this location, or give the folder that holds "
                f"{', '.join(LOCATIONS[stage])}."
            )
        for folder in folders:
            collection = read_loc360_sequence(folder)
            sequences.append(
                ImageSequence(f"{location}-{folder.name}", collection.panoramas, collection.near, collection.far)
            )
    return sequences


_SUFFIXES = (".mp4", ".mov", ".mkv", ".webm")


@dataclass(frozen=True, eq=False)
class VideoSequence:
    """Posed frames of a film.

    Attributes:
        name: the folder's.
        film: decoded when asked for.
        frames: the film's frame number of each pose.
        poses: cam2world, OpenCV axes, metres if the scale is right.
        mask: picture that is white where the panorama shows the scene; None for all of it.
        near, far: metres.
    """

    name: str
    film: VideoFile
    frames: tuple[int, ...]
    poses: tuple[Float[Tensor, "4 4"], ...]
    mask: Path | None = None
    near: float = NEAR
    far: float = FAR_SEQUENCE

    def read(self, frames: Sequence[int], height: int) -> Views:
        """The frames of those poses at (height, 2 height), in the order asked for.

        Raises:
            InputError: damaged video, or a wrong mask.
        """
        pictures = self.film.read([self.frames[i] for i in frames])
        scene = torch.ones(height, 2 * height, dtype=torch.bool) if self.mask is None else read_mask(self.mask, height)
        return Views(
            images=torch.stack([resize_panorama(pictures[self.frames[i]], height) for i in frames]),
            cam2world=torch.stack([self.poses[i] for i in frames]),
            masks=scene.expand(len(frames), -1, -1).clone(),
            near=self.near,
            far=self.far,
            names=tuple(f"{self.name}_{self.frames[i]:06d}" for i in frames),
        )


def read_insta360(root: Path | str) -> list[VideoSequence]:
    """The posed videos of a folder: its own, or those of the folders in it, by name.

    Raises:
        InputError: none there, or the first thing that is wrong in what is there.
    """
    root = Path(root).expanduser()
    if not root.is_dir():
        raise InputError(f"{root}: needed a folder with a video and its trajectory, got no such folder; check it.")
    inner = [folder for folder in sorted(root.iterdir()) if folder.is_dir() and _videos(folder)]
    folders = [root] if _videos(root) else inner
    if not folders:
        raise InputError(
            f"{root}: needed a folder with video.mp4 and a trajectory (*.kitti, *.tum, frame_trajectory.txt), got no "
            "video there or in its folders; see docs/input.md."
        )
    return [read_video_folder(folder) for folder in folders]


def read_video_folder(folder: Path) -> VideoSequence:
    """The video of one folder with its trajectory.

    Line i of a KITTI file belongs to frame i. Lines of a TUM file do too if there is one a frame; else they belong
    to the frame shown at their time (seconds since the first frame).

    Raises:
        InputError: no or several videos or trajectories, or poses that do not fit the frames.
    """
    videos = _videos(folder)
    named = [video for video in videos if video.stem == "video"]
    if len(named or videos) != 1:
        names = ", ".join(video.name for video in videos) or "none"
        raise InputError(f"{folder}: needed one video, got {names}; name the right one video.mp4.")
    source = trajectory_file(folder)
    if source is None:
        raise InputError(
            f"{folder}: needed a trajectory beside the video (*.kitti, *.tum, frame_trajectory.txt), got none."
        )
    film = open_video((named or videos)[0])
    if film.width != 2 * film.height:
        raise InputError(
            f"{film.path}: needed a 2:1 equirectangular video, got {film.width}x{film.height}; export it as such."
        )
    trajectory = read_trajectory(source)
    if trajectory.kind == "tum" and len(trajectory.poses) != len(film.stamps):
        frames = _frames_at(source, film)
    else:
        frames = _frames_in_order(source, film, len(trajectory.poses))
    scale = _scale(folder)
    poses = []
    for pose in trajectory.poses:
        scaled = pose.clone()
        scaled[:3, 3] *= scale
        poses.append(scaled)
    mask = folder / "mask.png"
    return VideoSequence(folder.resolve().name, film, frames, tuple(poses), mask if mask.is_file() else None)


def _videos(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.iterdir()) if path.is_file() and path.suffix.lower() in _SUFFIXES]


def _scale(folder: Path) -> float:
    source = folder / "scale.txt"
    if source.is_file():
        return read_number(source)
    warnings.warn(
        f"{folder}: no scale.txt, so the trajectory's unit is taken as one metre. If it is not (most SLAM programs "
        "choose their own), write metres per unit into scale.txt: near, far and depths depend on it.",
        stacklevel=4,
    )
    return 1.0


def _frames_in_order(source: Path, film: VideoFile, count: int) -> tuple[int, ...]:
    total = len(film.stamps)
    if count > total:
        raise InputError(
            f"{source}: needed at most one pose a frame ({total} frames in {film.path.name}), got {count}; take the "
            "trajectory of this video."
        )
    if count < total:
        warnings.warn(
            f"{source}: {count} poses for {total} frames of {film.path.name}; line i is taken as frame i and the last "
            f"{total - count} frames are left out. If the program lost frames in between, export TUM (with times).",
            stacklevel=5,
        )
    return tuple(range(count))


def _frames_at(source: Path, film: VideoFile) -> tuple[int, ...]:
    """The frame shown at each line's time."""
    seconds = torch.tensor(film.seconds, dtype=torch.float64)
    step = float(seconds.diff().median()) if len(seconds) > 1 else 1.0
    frames: list[int] = []
    for line in source.read_text(encoding="utf-8-sig").splitlines():
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        off, frame = (seconds - float(words[0])).abs().min(dim=0)
        if float(off) > step / 2 or (frames and int(frame) <= frames[-1]):
            raise InputError(
                f"{source}: needed ascending times in seconds since the first frame of {film.path.name} (0 to "
                f"{float(seconds[-1]):.3f}), got {words[0]}; shift the times, or give one line a frame."
            )
        frames.append(int(frame))
    return tuple(frames)
