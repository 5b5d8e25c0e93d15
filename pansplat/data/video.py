"""Writing films."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pansplat.atomic import replacing
from pansplat.errors import InputError

_ENCODERS = ("libx264", "libopenh264", "mpeg4")  # H.264 first: every browser and player has it


def write_video(path: Path | str, frames: Iterable[NDArray[np.uint8]], fps: float, *, quality: int = 18) -> int:
    """Write an MP4 film, whole or not at all, and return the number of frames; H.264 where PyAV has it.

    Frames of odd width or height lose their last column or row: the format holds even sizes only.

    Args:
        path: file to write, ending in .mp4.
        frames: RGB pictures (H W 3) uint8, all of one size; read one at a time.
        fps: pictures a second.
        quality: constant rate factor of the encoder, 0 (lossless) to 51; smaller is better and larger.

    Raises:
        InputError: not .mp4, no frame, a frame of another shape, `fps` not positive.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"cannot write {path}: needed a name ending in .mp4, got '{path.suffix}'; rename it.")
    if not 0 < fps < float("inf"):
        raise InputError(f"`fps` must be positive, got {fps}; choose one, such as 30.")
    import av

    with replacing(path) as temporary:
        count = 0
        with av.open(str(temporary), "w", options={"movflags": "+faststart"}) as film:
            stream: Any = None
            for count, frame in enumerate(frames, start=1):
                pixels = _check_frame(path, frame, count, None if stream is None else (stream.height, stream.width))
                if stream is None:
                    stream = _add_stream(film, pixels.shape[1], pixels.shape[0], fps, quality)
                picture = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                for packet in stream.encode(picture.reformat(format="yuv420p", dst_colorspace="ITU709")):
                    film.mux(packet)
            if stream is None:
                raise InputError(f"cannot write {path}: needed at least one frame, got none; nothing written.")
            for packet in stream.encode():
                film.mux(packet)
    return count


def video_encoder() -> str:
    """Name of the encoder that films are written with.

    Raises:
        InputError: PyAV has none of those we know.
    """
    import av
    import av.codec

    for name in _ENCODERS:
        if name in av.codecs_available:
            try:
                av.codec.Codec(name, "w")
                return name
            except ValueError:  # listed for decoding only
                continue
    raise InputError(f"needed PyAV with one of the encoders {_ENCODERS}, got none of them; reinstall `av`.")


def _add_stream(film: Any, width: int, height: int, fps: float, quality: int) -> Any:
    encoder = video_encoder()
    stream = film.add_stream(encoder, rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    if encoder == "libx264":
        stream.options = {"crf": str(quality), "preset": "medium"}
    else:
        stream.bit_rate = int(width * height * fps * 0.2)
    # Says how to turn the film back to RGB; players guess by size otherwise and shift the colours.
    context = stream.codec_context
    context.color_primaries, context.color_trc, context.colorspace, context.color_range = 1, 1, 1, 1
    return stream


def _check_frame(path: Path, frame: Any, number: int, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    pixels = np.asarray(frame)
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or min(pixels.shape) < 2:
        raise InputError(
            f"cannot write {path}: needed frames (H W 3) of uint8, got {pixels.dtype} {pixels.shape} as frame {number}."
        )
    pixels = np.ascontiguousarray(pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2])
    if size is not None and pixels.shape[:2] != size:
        raise InputError(
            f"cannot write {path}: needed frames of one size {size}, got {pixels.shape[:2]} as frame {number}."
        )
    return pixels
