"""Videos are written atomically, and frames are read exactly by number."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from pansplat.errors import InputError
from pansplat.images.video import open_video, video_encoder, write_video

COUNT = 70


def _frames(count: int, height: int = 32, width: int = 64) -> Iterator[np.ndarray]:
    for i in range(count):
        frame = np.full((height, width, 3), (200, 60, 30), np.uint8)
        frame[:, : width // 2] = 20 * i % 256
        yield frame


def test_decoded_frames_equal_the_written_frames(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", _frames(8), 24) == 8
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == 24
    frames = open_video(tmp_path / "a.mp4").read(range(8))
    assert len(frames) == 8
    for i, expected in enumerate(_frames(8)):
        error = np.abs(frames[i].astype(int) - expected)[:, [*range(28), *range(36, 64)]]  # chroma is blurred there
        assert error.max() <= 8, f"frame {i}"


def test_odd_sizes_lose_a_row_or_column_and_films_are_h264(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", _frames(2, 33, 65), 30)
    video = open_video(tmp_path / "a.mp4")
    assert (video.width, video.height, video_encoder()) == (64, 32, "libx264")


def test_a_failing_source_keeps_the_old_file(tmp_path: Path) -> None:
    def failing() -> Iterator[np.ndarray]:
        yield from _frames(100)  # more than the encoder keeps back
        raise RuntimeError("no more frames")

    write_video(tmp_path / "a.mp4", _frames(2), 30)
    before = (tmp_path / "a.mp4").read_bytes()
    with pytest.raises(RuntimeError, match="no more frames"):
        write_video(tmp_path / "a.mp4", failing(), 30)
    assert (tmp_path / "a.mp4").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.avi", lambda: _frames(1), 30, r"ending in \.mp4"),
        ("a.mp4", lambda: iter(()), 30, "at least one frame"),
        ("a.mp4", lambda: _frames(1), 0, "`fps` must be positive"),
        ("a.mp4", lambda: iter([np.zeros((8, 8), np.uint8)]), 30, "needed frames"),
        ("a.mp4", lambda: iter([np.zeros((8, 8, 3), np.float32)]), 30, "got float32"),
        ("a.mp4", lambda: iter([np.zeros((s, s, 3), np.uint8) for s in (16, 32)]), 30, "one size .* as frame 2"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path: Path, name, frames, fps, message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, frames(), fps)
    assert list(tmp_path.iterdir()) == []


def _numbered_frame(number: int) -> np.ndarray:
    """The bits of a number as eight black or white stripes, which survive any encoder."""
    frame = np.zeros((32, 64, 3), np.uint8)
    for bit in range(8):
        if number >> bit & 1:
            frame[:, 8 * bit : 8 * bit + 8] = 255
    return frame


def _number(frame: np.ndarray) -> int:
    return sum(1 << bit for bit in range(8) if frame[:, 8 * bit : 8 * bit + 8].mean() > 127)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video with B-frames: its frames are not stored in presentation order."""
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=24)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 32, "yuv420p", 1_000_000
        stream.codec_context.max_b_frames, stream.codec_context.gop_size = 2, 12
        for i in range(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(_numbered_frame(i), format="rgb24")))
        container.mux(stream.encode())
    return path


def test_frames_are_read_by_number_in_any_order_of_storage(path: Path) -> None:
    with av.open(str(path)) as container:
        stamps = [packet.pts for packet in container.demux(video=0) if packet.size]
    assert stamps != sorted(stamps), "the encoder kept the order: nothing is tested"
    video = open_video(path)
    assert (len(video.stamps), video.width, video.height) == (COUNT, 64, 32)
    for number in (0, 1, 33, 12, COUNT - 1):
        assert {k: _number(frame) for k, frame in video.read([number]).items()} == {number: number}
    assert {k: _number(frame) for k, frame in video.read([69, 2, 3, 2]).items()} == {2: 2, 3: 3, 69: 69}


def test_missing_frames_and_invalid_files_are_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needed frames 0 to 69, got 3 to 70"):
        open_video(path).read([3, 70])
    (tmp_path / "no.mp4").write_bytes(b"not a video")
    for name in ("no", "gone"):
        with pytest.raises(InputError, match=rf"{name}\.mp4: needed a readable video file"):
            open_video(tmp_path / f"{name}.mp4")


def test_a_damaged_video_is_refused(path: Path, tmp_path: Path) -> None:
    data = bytearray(path.read_bytes())
    start = data.find(b"mdat")
    data[start + 40 : start + 4000] = bytes(min(3960, len(data) - start - 40))
    (tmp_path / "damaged.mp4").write_bytes(data)
    with pytest.raises(InputError, match=r"damaged\.mp4: needed"):
        open_video(tmp_path / "damaged.mp4").read(range(COUNT))
