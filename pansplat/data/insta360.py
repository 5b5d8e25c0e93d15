"""One's own 360-degree video with the trajectory a SLAM program found.

Source: OFFICIAL.md 2.3. A folder has video.mp4 (or one other video), a trajectory (KITTI or TUM), maybe scale.txt (one
number that turns the trajectory's unit into metres) and mask.png.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pansplat.data.collection import FAR_SEQUENCE, NEAR
from pansplat.data.film import Film, open_film
from pansplat.data.images import read_mask, resize_panorama
from pansplat.data.poses import read_number, read_trajectory
from pansplat.data.sequences import trajectory_file
from pansplat.data.views import Views
from pansplat.errors import InputError

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
    film: Film
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
    film = open_film((named or videos)[0])
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


def _frames_in_order(source: Path, film: Film, count: int) -> tuple[int, ...]:
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


def _frames_at(source: Path, film: Film) -> tuple[int, ...]:
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
