"""Frame pairs are those of the official sampler, and videos are paired with the lines of their trajectory."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pansplat.errors import InputError
from pansplat.images.image_files import write_image
from pansplat.images.video import write_video
from pansplat.training.sequences import BoundedSampler, FramePair, read_insta360, read_loc360
from pansplat.training.sources import FixedFramePairs, RandomFramePairs

COUNT = 12


@pytest.mark.shared
@pytest.mark.parametrize(("name", "count", "max_gap"), [("360loc.n50", 50, 5), ("insta360.n400", 400, 30)])
def test_evaluation_pairs_equal_the_official_ones(golden: Callable, name: str, count: int, max_gap: int) -> None:
    pairs = BoundedSampler(2, max_gap).evaluation(count)
    rows = [[p.left, p.right, p.targets[0], p.targets[-1], len(p.targets)] for p in pairs]
    assert torch.equal(torch.tensor(rows), golden("units")[f"sampler.{name}"])


def test_training_gaps_cover_the_whole_range() -> None:
    generator = np.random.default_rng(0)
    pairs = [BoundedSampler(2, 5).training(20, generator) for _ in range(400)]
    assert {pair.right - pair.left for pair in pairs} == {2, 3, 4, 5}
    assert {pair.left for pair in pairs} >= {0, 17}
    assert all(0 <= pair.left <= pair.targets[0] <= pair.right < 20 for pair in pairs)
    assert {pair.targets[0] - pair.left for pair in pairs if pair.right - pair.left == 3} == {0, 1, 2, 3}


def test_gaps_are_limited_by_the_length_of_the_sequence() -> None:
    sampler = BoundedSampler(2, 30)
    assert sampler.training(2, np.random.default_rng(0)).right == 1
    assert sampler.evaluation(5, 1) == [FramePair(0, 4, (0, 1, 2, 3, 4))]
    with pytest.raises(InputError, match="two or more posed frames, got 1"):
        sampler.evaluation(1)
    with pytest.raises(InputError, match="got 3 and 2"):
        BoundedSampler(3, 2)


@pytest.fixture
def write_loc360(write_panorama: Callable, matrix: Callable) -> Callable[..., None]:
    def write(folder: Path, count: int = 9) -> None:
        for i in range(count):
            write_panorama(folder / "image" / f"{i}.png", i / 10)
        (folder / "camera_pose.json").write_text(json.dumps({f"{i}.png": matrix(i) for i in range(count)}))

    return write


def test_360loc_has_separate_locations_for_training_and_test(tmp_path: Path, write_loc360: Callable) -> None:
    for location in ("concourse", "hall", "piatrium"):
        write_loc360(tmp_path / location / "mapping" / "daytime_360_0")
    write_loc360(tmp_path / "hall" / "query_360" / "night_360_1", 5)
    (tmp_path / "hall" / "query_360" / "night_pinhole").mkdir()
    sequences = read_loc360(tmp_path, "train")
    names = [sequence.name for sequence in sequences]
    assert names == ["concourse-daytime_360_0", "hall-daytime_360_0", "hall-night_360_1", "piatrium-daytime_360_0"]
    with pytest.raises(InputError, match=r"atrium: needed 360Loc sequences .* for test, got none"):
        read_loc360(tmp_path, "test")
    source = RandomFramePairs(sequences, BoundedSampler(2, 5), draws=10)
    assert len(source) == 40
    first, again = source.sample(3, 8, 7), source.sample(3, 8, 7)
    assert first.name == again.name and torch.equal(first.context.images, again.context.images)
    assert len({source.sample(3, 8, seed).name for seed in range(8)}) > 1
    assert source.sample(25, 8, 0).name.startswith("hall-night_360_1")
    gap = float((first.context.cam2world[1] - first.context.cam2world[0])[0, 3])
    assert 2 <= gap <= 5 and first.context.far == 50


def test_360loc_is_evaluated_on_all_frames_of_a_pair(tmp_path: Path, write_loc360: Callable) -> None:
    write_loc360(tmp_path / "atrium" / "mapping" / "daytime_360_0")
    source = FixedFramePairs(read_loc360(tmp_path, "test"), BoundedSampler(2, 5).evaluation)
    assert len(source) == 100
    last = source.sample(99, 8, 0)
    assert last.context.names == ("5", "8") and last.targets.names == ("5", "6", "7", "8")
    assert torch.equal(last.context.images[0], last.targets.images[0])
    assert last.targets.cam2world[:, 0, 3].tolist() == [5, 6, 7, 8]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A video whose frame i has the value 20 i."""
    path = tmp_path_factory.mktemp("video") / "video.mp4"
    write_video(path, (np.full((16, 32, 3), 20 * i, np.uint8) for i in range(COUNT)), 10)
    return path.read_bytes()


@pytest.fixture
def write_folder(video: bytes) -> Callable[..., Path]:
    def write(folder: Path, lines: list[str], name: str = "frame_trajectory.txt", scale: str | None = "2") -> Path:
        folder.mkdir()
        (folder / "video.mp4").write_bytes(video)
        (folder / name).write_text("\n".join(lines))
        if scale is not None:
            (folder / "scale.txt").write_text(scale)
        return folder

    return write


def _kitti(count: int = COUNT) -> list[str]:
    return [f"1 0 0 {i} 0 1 0 0 0 0 1 0" for i in range(count)]


def test_frame_i_has_the_scaled_pose_of_line_i(tmp_path: Path, write_folder: Callable) -> None:
    for name in ("VID_b", "VID_a"):
        write_folder(tmp_path / name, _kitti())
    first, second = read_insta360(tmp_path)
    assert (first.name, second.name, len(first.poses)) == ("VID_a", "VID_b", COUNT)
    views = first.read([5, 3], 8)
    assert views.images.mean(dim=(1, 2, 3)).tolist() == pytest.approx([100 / 255, 60 / 255], abs=0.02)
    assert views.cam2world[:, 0, 3].tolist() == [10, 6]
    assert (views.near, views.far, views.names) == (0.45, 50.0, ("VID_a_000005", "VID_a_000003"))
    assert views.masks.all()


def test_without_scale_the_unit_is_a_metre_with_a_warning(tmp_path: Path, write_folder: Callable) -> None:
    folder = write_folder(tmp_path / "mine", _kitti(), scale=None)
    with pytest.warns(UserWarning, match=r"mine: no scale\.txt, so one unit of the trajectory is taken as one metre"):
        (sequence,) = read_insta360(folder)
    assert float(sequence.poses[3][0, 3]) == 3


def test_fewer_lines_than_frames_warn_and_more_are_refused(tmp_path: Path, write_folder: Callable) -> None:
    folder = write_folder(tmp_path / "mine", _kitti(9))
    with pytest.warns(UserWarning, match="9 poses for 12 frames of video.mp4; line i is used for frame i"):
        (sequence,) = read_insta360(folder)
    assert sequence.frames == tuple(range(9))
    (folder / "frame_trajectory.txt").write_text("\n".join(_kitti(13)))
    with pytest.raises(InputError, match=r"at most one pose per frame \(12 frames in video\.mp4\), got 13"):
        read_insta360(folder)


def test_tum_lines_are_matched_to_frames_by_time(tmp_path: Path, write_folder: Callable) -> None:
    lines = [f"{0.1 * i:.3f} {i} 0 0 0 0 0 1" for i in (0, 4, 5, 11)]
    (sequence,) = read_insta360(write_folder(tmp_path / "mine", lines, "mine.tum", "1"))
    assert sequence.frames == (0, 4, 5, 11)
    views = sequence.read([1, 3], 8)
    assert views.cam2world[:, 0, 3].tolist() == [4, 11]
    assert views.images.mean(dim=(1, 2, 3)).tolist() == pytest.approx([80 / 255, 220 / 255], abs=0.02)
    (tmp_path / "mine" / "mine.tum").write_text("\n".join([*lines, "9.5 0 0 0 0 0 0 1"]))
    with pytest.raises(InputError, match=r"needed ascending times in seconds since the first frame.*got 9.5"):
        read_insta360(tmp_path / "mine")


def test_the_mask_applies_to_all_frames(tmp_path: Path, write_folder: Callable) -> None:
    folder = write_folder(tmp_path / "mine", _kitti())
    mask = torch.ones(3, 16, 32)
    mask[:, 12:] = 0
    write_image(folder / "mask.png", mask)
    views = read_insta360(folder)[0].read([0, 1], 16)
    assert views.masks[:, :12].all() and not views.masks[:, 12:].any()


def test_incomplete_video_folders_are_refused(tmp_path: Path, write_folder: Callable) -> None:
    with pytest.raises(InputError, match="got no video there or in its subfolders"):
        read_insta360(tmp_path)
    with pytest.raises(InputError, match="got no such folder"):
        read_insta360(tmp_path / "gone")
    folder = write_folder(tmp_path / "mine", _kitti())
    (folder / "frame_trajectory.txt").unlink()
    with pytest.raises(InputError, match=r"needed one trajectory file .*got none; add it"):
        read_insta360(folder)
    (folder / "video.mp4").rename(folder / "a.mp4")
    write_video(folder / "b.mp4", [np.zeros((16, 30, 3), np.uint8)], 10)
    with pytest.raises(InputError, match=r"needed one video, got a\.mp4, b\.mp4"):
        read_insta360(folder)
    (folder / "a.mp4").unlink()
    (folder / "frame_trajectory.txt").write_text(_kitti()[0])
    with pytest.raises(InputError, match="needed a 2:1 equirectangular video, got 30x16"):
        read_insta360(folder)
