"""Writing MP4 files."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pansplat.errors import InputError
from pansplat.images.panorama_metadata import Stereo, mark_spherical_video
from pansplat.system.atomic import replacing
from pansplat.system.files import SOFTWARE

_ENCODERS = ("libx264", "libopenh264", "mpeg4")  # H.264 first: every browser and player supports it


def write_video(
    path: Path | str,
    frames: Iterable[NDArray[np.uint8]],
    fps: float,
    *,
    panorama: bool = False,
    stereo: Stereo = "mono",
) -> int:
    """Write an MP4 file atomically and return the number of frames; H.264 if PyAV supports it.

    The format supports even sizes only: frames of odd width or height lose their last column or row.

    Args:
        path: file to write, ending in .mp4.
        frames: RGB images (H W 3), uint8, all of one size; consumed one at a time.
        fps: frames per second.
        panorama: whether the frames are equirectangular panoramas; players then show the film as 360 degrees.
        stereo: arrangement of the eyes in a panorama's frame.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"cannot write {path}: needed a name ending in .mp4, got '{path.suffix}'; rename it.")
    if not 0 < fps < float("inf"):
        raise InputError(f"`fps` must be positive, got {fps}; choose one, such as 30.")
    import av

    with replacing(path) as temporary:
        count = 0
        with av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container:
            stream: Any = None
            for count, frame in enumerate(frames, start=1):
                pixels = _check_frame(path, frame, count, None if stream is None else (stream.height, stream.width))
                if stream is None:
                    encoder = video_encoder()
                    stream = _add_stream(container, encoder, pixels.shape[1], pixels.shape[0], fps)
                video_frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                for packet in stream.encode(video_frame.reformat(format="yuv420p", dst_colorspace="ITU709")):
                    container.mux(packet)
            if stream is None:
                raise InputError(f"cannot write {path}: needed at least one frame, got none; nothing was written.")
            for packet in stream.encode():
                container.mux(packet)
        if panorama:
            mark_spherical_video(temporary, stereo)
        with open(temporary, "ab") as file:  # players skip a box of this type
            file.write((8 + len(SOFTWARE)).to_bytes(4, "big") + b"free" + SOFTWARE.encode())
    return count


def video_encoder() -> str:
    """Name of the encoder that `write_video` uses."""
    import av
    import av.codec

    for name in _ENCODERS:
        if name in av.codecs_available:
            try:
                av.codec.Codec(name, "w")
                return name
            except ValueError:  # available for decoding only
                continue
    raise InputError(f"needed PyAV with one of the encoders {_ENCODERS}, got none of them; reinstall `av`.")


def _add_stream(container: Any, encoder: str, width: int, height: int, fps: float) -> Any:
    stream = container.add_stream(encoder, rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    if encoder == "libx264":
        stream.options = {"crf": "18", "preset": "medium"}
    else:
        stream.bit_rate = int(width * height * fps * 0.2)
    # BT.709, limited range. Without these tags players guess the colour space from the size, and colours shift.
    context = stream.codec_context
    context.color_primaries, context.color_trc, context.colorspace, context.color_range = 1, 1, 1, 1
    return stream


def _check_frame(path: Path, frame: Any, number: int, size: tuple[int, int] | None) -> NDArray[np.uint8]:
    """The frame cropped to an even size."""
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
