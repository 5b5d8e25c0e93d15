"""Videos are written atomically, and decode to the frames that were given."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest
from refusals import expect_error

from pansplat.images.video import video_encoder, write_video


def _frames(count: int, height: int = 32, width: int = 64) -> Iterator[np.ndarray]:
    for i in range(count):
        frame = np.full((height, width, 3), (200, 60, 30), np.uint8)
        frame[:, : width // 2] = 20 * i % 256
        yield frame


def test_decoded_frames_equal_the_written_frames(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", _frames(8), 24) == 8
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == 24
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 8
    for i, expected in enumerate(_frames(8)):
        error = np.abs(frames[i].astype(int) - expected)[:, [*range(28), *range(36, 64)]]  # chroma is blurred there
        assert error.max() <= 8, f"frame {i}"


def test_odd_sizes_lose_a_row_or_column_and_films_are_h264(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", _frames(2, 33, 65), 30)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height, video_encoder()) == (64, 32, "libx264")


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.avi", lambda: _frames(1), 30, r"ending in \.mp4"),
        ("a.mp4", lambda: iter(()), 30, "frame"),
        ("a.mp4", lambda: _frames(1), 0, "`fps`"),
        ("a.mp4", lambda: iter([np.zeros((8, 8), np.uint8)]), 30, "needed frames"),
        ("a.mp4", lambda: iter([np.zeros((8, 8, 3), np.float32)]), 30, "got float32"),
        ("a.mp4", lambda: iter([np.zeros((s, s, 3), np.uint8) for s in (16, 32)]), 30, "frame 2"),
    ],
)
def test_invalid_arguments_are_refused(tmp_path: Path, name, frames, fps, message: str) -> None:
    expect_error(message, lambda: write_video(tmp_path / name, frames(), fps))
    assert list(tmp_path.iterdir()) == []
