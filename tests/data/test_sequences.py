"""One's own video becomes a posed sequence: frame i has line i, or the line of its time."""

from pathlib import Path

import numpy as np
import pytest

from pansplat.data.images import write_image
from pansplat.data.sequences import read_insta360
from pansplat.data.video import write_video
from pansplat.errors import InputError

COUNT = 12


def _folder(folder: Path, lines: list[str], name: str = "frame_trajectory.txt", scale: str | None = "2") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    write_video(folder / "video.mp4", (np.full((16, 32, 3), 20 * i, np.uint8) for i in range(COUNT)), 10)
    (folder / name).write_text("\n".join(lines))
    if scale is not None:
        (folder / "scale.txt").write_text(scale)
    return folder


def _kitti(count: int = COUNT) -> list[str]:
    return [f"1 0 0 {i} 0 1 0 0 0 0 1 0" for i in range(count)]


def test_frame_i_has_line_i_and_the_scale(tmp_path: Path) -> None:
    for name in ("VID_b", "VID_a"):
        _folder(tmp_path / name, _kitti())
    first, second = read_insta360(tmp_path)
    assert (first.name, second.name, len(first.poses)) == ("VID_a", "VID_b", COUNT)
    views = first.read([5, 3], 8)
    assert views.images.mean(dim=(1, 2, 3)).tolist() == pytest.approx([100 / 255, 60 / 255], abs=0.02)
    assert views.cam2world[:, 0, 3].tolist() == [10, 6]
    assert (views.near, views.far, views.names) == (0.45, 50.0, ("VID_a_000005", "VID_a_000003"))
    assert views.masks.all()


def test_without_a_scale_the_unit_is_a_metre_and_a_note_says_so(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "mine", _kitti(), scale=None)
    with pytest.warns(UserWarning, match=r"mine: no scale\.txt, so one unit of the trajectory is taken as one metre"):
        (sequence,) = read_insta360(folder)
    assert float(sequence.poses[3][0, 3]) == 3


def test_fewer_lines_than_frames_are_used_with_a_note_and_more_are_refused(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "mine", _kitti(9))
    with pytest.warns(UserWarning, match="9 poses for 12 frames of video.mp4; line i is used for frame i"):
        (sequence,) = read_insta360(folder)
    assert sequence.frames == tuple(range(9))
    (folder / "frame_trajectory.txt").write_text("\n".join(_kitti(13)))
    with pytest.raises(InputError, match=r"at most one pose per frame \(12 frames in video\.mp4\), got 13"):
        read_insta360(folder)


def test_tum_lines_find_their_frames_by_time(tmp_path: Path) -> None:
    lines = [f"{0.1 * i:.3f} {i} 0 0 0 0 0 1" for i in (0, 4, 5, 11)]
    (sequence,) = read_insta360(_folder(tmp_path / "mine", lines, "mine.tum", "1"))
    assert sequence.frames == (0, 4, 5, 11)
    views = sequence.read([1, 3], 8)
    assert views.cam2world[:, 0, 3].tolist() == [4, 11]
    assert views.images.mean(dim=(1, 2, 3)).tolist() == pytest.approx([80 / 255, 220 / 255], abs=0.02)
    (tmp_path / "mine" / "mine.tum").write_text("\n".join([*lines, "9.5 0 0 0 0 0 0 1"]))
    with pytest.raises(InputError, match=r"needed ascending times in seconds since the first frame.*got 9.5"):
        read_insta360(tmp_path / "mine")


def test_a_mask_counts_for_all_frames(tmp_path: Path) -> None:
    import torch

    folder = _folder(tmp_path / "mine", _kitti())
    mask = torch.ones(3, 16, 32)
    mask[:, 12:] = 0
    write_image(folder / "mask.png", mask)
    views = read_insta360(folder)[0].read([0, 1], 16)
    assert views.masks[:, :12].all() and not views.masks[:, 12:].any()


def test_folders_without_what_is_needed_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="got no video there or in its subfolders"):
        read_insta360(tmp_path)
    with pytest.raises(InputError, match="got no such folder"):
        read_insta360(tmp_path / "gone")
    folder = _folder(tmp_path / "mine", _kitti())
    (folder / "frame_trajectory.txt").unlink()
    with pytest.raises(InputError, match="needed a trajectory for the video"):
        read_insta360(folder)
    (folder / "video.mp4").rename(folder / "a.mp4")
    write_video(folder / "b.mp4", [np.zeros((16, 30, 3), np.uint8)], 10)
    with pytest.raises(InputError, match=r"needed one video, got a\.mp4, b\.mp4"):
        read_insta360(folder)
    (folder / "a.mp4").unlink()
    (folder / "frame_trajectory.txt").write_text(_kitti()[0])
    with pytest.raises(InputError, match="needed a 2:1 equirectangular video, got 30x16"):
        read_insta360(folder)
