"""Sequences of posed frames (360Loc, own videos), and the choice of context and target frames."""

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

from pansplat.errors import InputError
from pansplat.images.image_files import read_mask, resize_panorama
from pansplat.images.masks import lift_black_surfaces
from pansplat.images.video import VideoFile, open_video
from pansplat.inputs.folder_formats import CAMERA_POSES, choose_trajectory, read_loc360_sequence
from pansplat.inputs.folders import VIDEO_FILES, require_known_masks
from pansplat.inputs.pairs import FAR_SEQUENCE, NEAR, Pair, Panorama, find_mask
from pansplat.inputs.poses import read_number, read_trajectory
from pansplat.inputs.views import Sample, Views, select_views
from pansplat.system.files import expand_home

Stage = Literal["train", "val", "test"]

LOCATIONS: dict[str, tuple[str, ...]] = {
    "train": ("concourse", "hall", "piatrium"),
    "val": ("atrium",),
    "test": ("atrium",),
}
"""Locations of 360Loc by stage (docs/official.md, section 2.2)."""


@dataclass(frozen=True)
class FramePair:
    """Frame numbers of the two context views and of the targets."""

    left: int
    right: int
    targets: tuple[int, ...]


@dataclass(frozen=True)
class BoundedSampler:
    """Chooses two frames with a bounded gap, and targets between them. Source: docs/official.md, section 2.5.

    Attributes:
        min_gap, max_gap: frames from left to right; 2 and 5 for 360Loc, 2 and 30 for Insta360.
        training_gap: "uniform" samples gaps from min_gap to max_gap. "original" always uses min_gap: on paths that are
            not circles the official code replaces max_gap by min_gap.
    """

    min_gap: int = 2
    max_gap: int = 5
    training_gap: Literal["uniform", "original"] = "uniform"

    def __post_init__(self) -> None:
        if not 1 <= self.min_gap <= self.max_gap:
            raise InputError(f"needed 1 <= min_gap <= max_gap frames, got {self.min_gap} and {self.max_gap}.")

    def training(self, count: int, generator: np.random.Generator) -> FramePair:
        """A random pair of a sequence of `count` frames, and one target from left to right."""
        longest = _longest_gap(count)
        max_gap = min(self.max_gap if self.training_gap == "uniform" else self.min_gap, longest)
        gap = int(generator.integers(min(self.min_gap, max_gap), max_gap, endpoint=True))
        left = int(generator.integers(0, count - gap))
        return FramePair(left, left + gap, (int(generator.integers(left, left + gap, endpoint=True)),))

    def evaluation(self, count: int, draws: int = 100) -> list[FramePair]:
        """`draws` evenly spaced pairs of a sequence of `count` frames; targets are all frames from left to right."""
        gap = min((self.min_gap + self.max_gap) // 2, _longest_gap(count))
        lefts = [(count - gap - 1) * i // max(draws - 1, 1) for i in range(draws)]
        return [FramePair(left, left + gap, tuple(range(left, left + gap + 1))) for left in lefts]


def _longest_gap(count: int) -> int:
    if count < 2:
        raise InputError(f"needed a sequence of two or more posed frames, got {count}; remove it.")
    return count - 1


@runtime_checkable
class FrameSequence(Protocol):
    """A sequence of posed panoramas."""

    @property
    def name(self) -> str: ...

    @property
    def poses(self) -> Sequence[Float[Tensor, "4 4"]]:
        """Camera to world of each frame, OpenCV axes, metres."""
        ...

    def read(self, frames: Sequence[int], height: int) -> Views:
        """The given frames at (height, 2 height), in the order of `frames`."""
        ...


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """A `FrameSequence` of image files. Frames without a mask file show the scene in all pixels."""

    name: str
    panoramas: tuple[Panorama, ...]
    near: float = NEAR
    far: float = FAR_SEQUENCE

    @property
    def poses(self) -> Sequence[Float[Tensor, "4 4"]]:
        return [panorama.cam2world for panorama in self.panoramas]

    def read(self, frames: Sequence[int], height: int) -> Views:
        """See `FrameSequence.read`."""
        chosen = tuple(self.panoramas[frame] for frame in frames)
        return Pair(self.name, chosen[0].image.parent, (), chosen, self.near, self.far).load_targets(height)


@dataclass(frozen=True, eq=False)
class VideoSequence:
    """A `FrameSequence` of the posed frames of a video.

    Attributes:
        name: name of the folder.
        video: frames are decoded by `read`.
        frames: frame number in the video of each pose.
        poses: cam2world, OpenCV axes, metres if scale.txt is right.
        mask: image that is white where the panoramas show the scene; None for all pixels.
        near, far: metres.
    """

    name: str
    video: VideoFile
    frames: tuple[int, ...]
    poses: tuple[Float[Tensor, "4 4"], ...]
    mask: Path | None = None
    near: float = NEAR
    far: float = FAR_SEQUENCE

    def read(self, frames: Sequence[int], height: int) -> Views:
        """See `FrameSequence.read`."""
        pixels = self.video.read([self.frames[i] for i in frames])
        scene = torch.ones(height, 2 * height, dtype=torch.bool) if self.mask is None else read_mask(self.mask, height)
        return Views(
            images=torch.stack([lift_black_surfaces(resize_panorama(pixels[self.frames[i]], height)) for i in frames]),
            cam2world=torch.stack([self.poses[i] for i in frames]),
            masks=scene.expand(len(frames), -1, -1).clone(),
            near=self.near,
            far=self.far,
            names=tuple(f"{self.name}_{self.frames[i]:06d}" for i in frames),
        )


def read_frame_pair(sequence: FrameSequence, pair: FramePair, height: int) -> Sample:
    """The sample of a frame pair. Each frame is read once, even if it is both context and target."""
    frames = sorted({pair.left, pair.right, *pair.targets})
    views = sequence.read(frames, height)
    index = {frame: i for i, frame in enumerate(frames)}
    return Sample(
        f"{sequence.name}-{pair.left:06d}-{pair.right:06d}",
        select_views(views, [index[pair.left], index[pair.right]]),
        select_views(views, [index[frame] for frame in pair.targets]),
    )


def read_loc360(root: Path | str, stage: Stage) -> list[ImageSequence]:
    """The 360Loc sequences of a stage's locations, by name: ROOT/{location}/{mapping|query_360}/{*360*}/."""
    root = expand_home(root)
    sequences = []
    for location in LOCATIONS[stage]:
        folders = [
            folder
            for part in ("mapping", "query_360")
            for folder in sorted((root / location / part).glob("*360*"))
            if (folder / CAMERA_POSES).is_file()
        ]
        if not folders:
            raise InputError(
                f"{root / location}: needed 360Loc sequences (mapping/*360*/camera_pose.json or the same in query_360) "
                f"for {stage}, got none; download this location, or give the folder that holds "
                f"{', '.join(LOCATIONS[stage])}."
            )
        for folder in folders:
            collection = read_loc360_sequence(folder / CAMERA_POSES, folder)
            require_known_masks(folder, collection.views)
            name = f"{location}-{folder.name}"
            sequences.append(ImageSequence(name, collection.panoramas, collection.near, collection.far))
    return sequences


def read_insta360(root: Path | str) -> list[VideoSequence]:
    """The posed videos of a folder or of its subfolders, by name. Source: docs/official.md, section 2.3."""
    root = expand_home(root)
    if not root.is_dir():
        raise InputError(f"{root}: needed a folder with a video and its trajectory, got no such folder; check it.")
    folders = [root] if _list_videos(root) else [f for f in sorted(root.iterdir()) if f.is_dir() and _list_videos(f)]
    if not folders:
        raise InputError(
            f"{root}: needed a folder with video.mp4 and a trajectory (*.kitti, *.tum, frame_trajectory.txt), got no "
            "video there or in its subfolders; see docs/input.md."
        )
    return [read_video_folder(folder) for folder in folders]


def read_video_folder(folder: Path) -> VideoSequence:
    """A video with the poses of its trajectory; scale.txt (metres per unit) and mask.png are optional.

    Line i of a KITTI file is the pose of frame i. So is line i of a TUM file with one line per frame; otherwise a TUM
    line is the pose of the frame shown at its time (seconds since the first frame).
    """
    videos = _list_videos(folder)
    default = [video for video in videos if video.stem == "video"]
    if len(default or videos) != 1:
        names = ", ".join(video.name for video in videos) or "none"
        raise InputError(f"{folder}: needed one video, got {names}; name the right one video.mp4.")
    source = choose_trajectory(folder)
    video = open_video((default or videos)[0])
    if video.width != 2 * video.height:
        raise InputError(
            f"{video.path}: needed a 2:1 equirectangular video, got {video.width}x{video.height}; export it as such."
        )
    require_known_masks(folder)
    trajectory = read_trajectory(source, scale=_read_scale(folder))
    if trajectory.kind == "tum" and len(trajectory.poses) != len(video.stamps):
        frames = _frames_by_time(source, video)
    else:
        frames = _frames_in_order(source, video, len(trajectory.poses))
    return VideoSequence(folder.resolve().name, video, frames, trajectory.poses, find_mask(video.path, folder))


def _list_videos(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.iterdir()) if path.is_file() and path.suffix.lower() in VIDEO_FILES]


def _read_scale(folder: Path) -> float:
    source = folder / "scale.txt"
    if source.is_file():
        return read_number(source)
    warnings.warn(
        f"{folder}: no scale.txt, so one unit of the trajectory is taken as one metre. Most SLAM programs use another "
        "unit: write metres per unit into scale.txt, because near, far and depths depend on it.",
        stacklevel=4,
    )
    return 1.0


def _frames_in_order(source: Path, video: VideoFile, count: int) -> tuple[int, ...]:
    total = len(video.stamps)
    if count > total:
        raise InputError(
            f"{source}: needed at most one pose per frame ({total} frames in {video.path.name}), got {count}; use the "
            "trajectory of this video."
        )
    if count < total:
        warnings.warn(
            f"{source}: {count} poses for {total} frames of {video.path.name}; line i is used for frame i and the last "
            f"{total - count} frames are ignored. If frames were lost in between, export TUM, which has times.",
            stacklevel=5,
        )
    return tuple(range(count))


def _frames_by_time(source: Path, video: VideoFile) -> tuple[int, ...]:
    """Number of the frame that is shown at the time of each line."""
    seconds = torch.tensor(video.seconds, dtype=torch.float64)
    step = float(seconds.diff().median()) if len(seconds) > 1 else 1.0
    frames: list[int] = []
    for line in source.read_text(encoding="utf-8-sig").splitlines():
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        difference, frame = (seconds - float(words[0])).abs().min(dim=0)
        if float(difference) > step / 2 or (frames and int(frame) <= frames[-1]):
            raise InputError(
                f"{source}: needed ascending times in seconds since the first frame of {video.path.name} (0 to "
                f"{float(seconds[-1]):.3f}), got {words[0]}; shift the times, or write one line per frame."
            )
        frames.append(int(frame))
    return tuple(frames)
