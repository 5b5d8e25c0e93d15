"""Reading films: exactly the frame asked for, whatever the encoder did with the order of frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pansplat.errors import InputError

_NEAR = 48  # frames; nearer ones are reached by decoding on, farther ones by seeking


@dataclass(frozen=True, eq=False)
class Film:
    """A video file whose frames are counted, not yet decoded.

    Attributes:
        path: the file.
        stamps: presentation time of each frame in units of `time_base`, ascending.
        time_base: seconds.
        width, height: pixels.
    """

    path: Path
    stamps: tuple[int, ...]
    time_base: Fraction
    width: int
    height: int

    @property
    def seconds(self) -> list[float]:
        """Time of each frame after the first."""
        return [float((stamp - self.stamps[0]) * self.time_base) for stamp in self.stamps]

    def read(self, frames: Sequence[int]) -> dict[int, NDArray[np.uint8]]:
        """Those frames as RGB (H W 3), by number from 0 in the order in which they are shown.

        Raises:
            InputError: no such frame, or damaged data.
        """
        wanted = sorted(set(frames))
        if wanted and not 0 <= wanted[0] <= wanted[-1] < len(self.stamps):
            raise InputError(
                f"{self.path}: needed frames 0 to {len(self.stamps) - 1}, got {wanted[0]} to {wanted[-1]}."
            )
        found: dict[int, NDArray[np.uint8]] = {}
        with _opened(self.path) as film:
            film.streams.video[0].thread_type = "AUTO"
            for group in _groups(wanted):
                found |= self._decode(film, group, self.stamps[group[0]])
                missing = [frame for frame in group if frame not in found]
                if missing:  # some files' key frames cannot be trusted: decode from the start
                    found |= self._decode(film, missing, self.stamps[0])
        missing = [frame for frame in wanted if frame not in found]
        if missing:
            raise InputError(
                f"{self.path}: needed {len(wanted)} frames, got none for {missing[:5]}: the file is damaged there; "
                "copy or encode it again."
            )
        return found

    def _decode(self, film: Any, frames: Sequence[int], seek_to: int) -> dict[int, NDArray[np.uint8]]:
        """Frames met on the way from the key frame at or before a time."""
        from av.error import FFmpegError

        numbers = {self.stamps[frame]: frame for frame in frames}
        last = max(numbers)
        found = {}
        stream = film.streams.video[0]
        try:
            film.seek(seek_to, stream=stream)
            for picture in film.decode(stream):
                if picture.pts in numbers:
                    found[numbers[picture.pts]] = picture.to_ndarray(format="rgb24")
                if len(found) == len(numbers) or (picture.pts is not None and picture.pts > last):
                    break
        except FFmpegError as error:
            raise InputError(f"{self.path}: needed readable frames, got '{error}'; copy or encode it again.") from error
        return found


def open_film(path: Path | str) -> Film:
    """A video file with the times of its frames, found without decoding.

    Raises:
        InputError: no such file, no video in it, or frames without times.
    """
    path = Path(path)
    with _opened(path) as film:
        from av.error import FFmpegError

        if not film.streams.video:
            raise InputError(f"{path}: needed a video, got a file without pictures; give another file.")
        stream = film.streams.video[0]
        try:
            packets = [packet for packet in film.demux(stream) if packet.size and not packet.is_discard]
        except FFmpegError as error:
            raise InputError(f"{path}: needed a complete video, got '{error}'; copy it again.") from error
        stamps = sorted({packet.pts for packet in packets if packet.pts is not None})
        if not stamps or len(stamps) != len(packets):
            raise InputError(
                f"{path}: needed a time for each frame, got {len(stamps)} times for {len(packets)} frames; write it "
                "again as .mp4 (ffmpeg -i FILE -c:v libx264 -crf 12 video.mp4)."
            )
        return Film(path, tuple(stamps), stream.time_base, stream.width, stream.height)


def _opened(path: Path) -> Any:
    import av
    from av.error import FFmpegError

    try:
        return av.open(str(path))
    except (OSError, FFmpegError) as error:
        raise InputError(f"{path}: needed a readable video file, got '{error}'; check it.") from error


def _groups(frames: Sequence[int]) -> Iterator[list[int]]:
    """Runs of frames near each other."""
    group: list[int] = []
    for frame in frames:
        if group and frame - group[-1] > _NEAR:
            yield group
            group = []
        group.append(frame)
    if group:
        yield group
