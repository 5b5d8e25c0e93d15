"""Any frame of a film is found by its number, whatever order the encoder put frames in."""

from pathlib import Path

import av
import numpy as np
import pytest

from pansplat.data.video import open_video, write_video
from pansplat.errors import InputError

COUNT = 70


def _frame(number: int) -> np.ndarray:
    """The number in eight black or white stripes, which no encoder blurs away."""
    frame = np.zeros((32, 64, 3), np.uint8)
    for bit in range(8):
        if number >> bit & 1:
            frame[:, 8 * bit : 8 * bit + 8] = 255
    return frame


def _number(frame: np.ndarray) -> int:
    return sum(1 << bit for bit in range(8) if frame[:, 8 * bit : 8 * bit + 8].mean() > 127)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film whose frames are stored out of order: some are told from frames shown later."""
    path = tmp_path_factory.mktemp("film") / "video.mp4"
    with av.open(str(path), "w") as film:
        stream = film.add_stream("mpeg4", rate=24)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 32, "yuv420p", 1_000_000
        stream.codec_context.max_b_frames, stream.codec_context.gop_size = 2, 12
        for i in range(COUNT):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(_frame(i), format="rgb24")))
        film.mux(stream.encode())
    return path


def test_every_frame_is_the_one_asked_for(path: Path) -> None:
    with av.open(str(path)) as container:
        shown = [packet.pts for packet in container.demux(video=0) if packet.size]
    assert shown != sorted(shown), "the encoder kept the order: nothing is tested"
    film = open_video(path)
    assert (len(film.stamps), film.width, film.height) == (COUNT, 64, 32)
    assert film.seconds == pytest.approx([i / 24 for i in range(COUNT)], abs=1e-3)
    for number in (0, 1, 33, 12, COUNT - 1):
        assert {k: _number(frame) for k, frame in film.read([number]).items()} == {number: number}
    assert {k: _number(frame) for k, frame in film.read([69, 2, 3, 2]).items()} == {2: 2, 3: 3, 69: 69}


def test_colours_come_back(tmp_path: Path) -> None:
    red = np.zeros((32, 64, 3), np.uint8)
    red[..., 0], red[..., 1] = 200, 40
    write_video(tmp_path / "red.mp4", [red] * 3, 24)
    frame = open_video(tmp_path / "red.mp4").read([1])[1]
    assert np.abs(frame.astype(int) - red).max() <= 4


def test_frames_beyond_the_end_and_other_files_are_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="needed frames 0 to 69, got 3 to 70"):
        open_video(path).read([3, 70])
    (tmp_path / "no.mp4").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=r"no\.mp4: needed a readable video file"):
        open_video(tmp_path / "no.mp4")
    with pytest.raises(InputError, match="needed a readable video file"):
        open_video(tmp_path / "gone.mp4")


def test_a_damaged_film_is_refused(path: Path, tmp_path: Path) -> None:
    data = bytearray(path.read_bytes())
    start = data.find(b"mdat")
    data[start + 40 : start + 4000] = bytes(min(3960, len(data) - start - 40))
    (tmp_path / "damaged.mp4").write_bytes(data)
    with pytest.raises(InputError, match=r"damaged\.mp4: needed"):
        open_video(tmp_path / "damaged.mp4").read(range(COUNT))
