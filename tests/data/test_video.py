"""Films are whole, play back as they were given, or are not there."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from pansplat.data.video import video_encoder, write_video
from pansplat.errors import InputError


def _frames(count: int, height: int = 32, width: int = 64) -> Iterator[np.ndarray]:
    for i in range(count):
        frame = np.full((height, width, 3), (200, 60, 30), np.uint8)
        frame[:, : width // 2] = 20 * i
        yield frame


def test_a_film_plays_back_as_it_was_given(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", _frames(8), 24) == 8
    with av.open(str(tmp_path / "a.mp4")) as film:
        stream = film.streams.video[0]
        assert stream.average_rate == 24
        frames = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
    assert len(frames) == 8
    for i, (frame, given) in enumerate(zip(frames, _frames(8), strict=True)):
        error = np.abs(frame.astype(int) - given)[:, [*range(28), *range(36, 64)]]  # chroma is shared at the edge
        assert error.max() <= 8, f"frame {i}"


def test_films_are_h264() -> None:
    assert video_encoder() == "libx264"


def test_odd_sizes_lose_one_row_or_column(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", _frames(2, 33, 65), 30)
    with av.open(str(tmp_path / "a.mp4")) as film:
        assert (film.streams.video[0].width, film.streams.video[0].height) == (64, 32)


def test_a_failing_source_leaves_the_old_film(tmp_path: Path) -> None:
    def failing() -> Iterator[np.ndarray]:
        yield from _frames(3)
        raise RuntimeError("out of light")

    write_video(tmp_path / "a.mp4", _frames(2), 30)
    before = (tmp_path / "a.mp4").read_bytes()
    with pytest.raises(RuntimeError, match="out of light"):
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
        (
            "a.mp4",
            lambda: iter([np.zeros((s, s, 3), np.uint8) for s in (16, 32)]),
            30,
            "one size .* as frame 2",
        ),
    ],
)
def test_bad_films_are_refused(tmp_path: Path, name, frames, fps, message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, frames(), fps)
    assert list(tmp_path.iterdir()) == []
