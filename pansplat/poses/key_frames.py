"""Key frames of a 360-degree video: sharp frames with parallax between them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from pansplat.errors import InputError
from pansplat.images.image_files import write_image
from pansplat.images.panorama_metadata import read_xmp
from pansplat.images.video import open_video
from pansplat.inputs.folders import require_known_masks
from pansplat.poses.axes import NO_PRIOR
from pansplat.poses.features import Features, detect_features, match_features
from pansplat.poses.two_view import estimate_relative_pose
from pansplat.system.files import make_portable_name, require_replaceable
from pansplat.system.progress import report_progress, stage

_CANDIDATES_PER_FRAME = 4  # frames that are decoded for each key frame; the sharpest of them is used
_SMALL, _FEATURES, _MATCHES = 512, 2000, 300  # to measure parallax: height of the frames, pixels; the best of each
_MIN_PARALLAX = 0.05  # radians between key frames


@stage()
def extract_key_frames(path: Path, folder: Path, count: int, *, overwrite: bool = False) -> list[Path]:
    """Write at most `count` key frames of a video as VIDEO_NUMBER.png, and return them.

    The video is divided into intervals of equal length. The sharpest of some frames of each interval is a candidate; it
    is left out if its parallax to the last key frame is small.
    """
    video = open_video(path)
    require_known_masks(path.parent)
    if video.width != 2 * video.height:
        raise InputError(f"{path}: needed a 2:1 equirectangular video, got {video.width}x{video.height}; convert it.")
    if count < 2:
        raise InputError(f"`count` must be at least 2 key frames, got {count}")
    numbers = np.unique(np.linspace(0, len(video.stamps) - 1, count * _CANDIDATES_PER_FRAME).round().astype(int))
    files = {int(n): folder / f"{make_portable_name(path.stem) or 'frame'}_{n:06d}.png" for n in numbers}
    others = [file for file in files.values() if b'CreatorTool="pansplat"' not in read_xmp(file)]
    require_replaceable("key frames", others, overwrite)
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    last: Features | None = None
    groups = np.array_split(numbers, count)
    for position, group in enumerate(groups):
        report_progress("reading the video", position / len(groups))
        if not len(group):
            continue
        frames = video.read([int(number) for number in group])
        number, frame = max(frames.items(), key=lambda item: _sharpness(item[1]))
        grey, height = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), min(_SMALL, len(frame))
        small = cv2.resize(grey, (2 * height, height), interpolation=cv2.INTER_AREA)
        features = detect_features(small, count=_FEATURES)
        if last is not None:
            matches = match_features(last, features).best(_MATCHES)
            relation = estimate_relative_pose(last, features, matches, NO_PRIOR)
            if len(relation.indices) >= 20 and relation.parallax < _MIN_PARALLAX:
                continue
        last = features
        written.append(files[number])
        write_image(written[-1], frame, panorama="photograph")
    if len(written) < 2:
        raise InputError(f"{path}: needed a moving camera, got no parallax between its frames; give another video.")
    return written


def _sharpness(frame: UInt8[Array, "height width 3"]) -> float:
    small = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())
