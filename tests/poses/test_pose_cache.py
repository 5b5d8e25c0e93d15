"""Features and relative poses on disk."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from pansplat.poses import estimate
from pansplat.poses.estimate import estimate_poses
from pansplat.poses.pose_cache import PoseCache, hash_parts

SAMPLE = Path(__file__).parents[2] / "assets" / "living_room"


@dataclass(frozen=True, eq=False)
class _Inner:
    name: str
    numbers: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class _Outer:
    array: np.ndarray
    tensor: torch.Tensor
    inner: _Inner
    other: _Inner | None


def make_value() -> _Outer:
    return _Outer(np.arange(6.0).reshape(2, 3), torch.ones(2, 2, dtype=torch.float16), _Inner("é", (1.5, np.inf)), None)


def test_a_value_is_read_as_it_was_written(tmp_path: Path) -> None:
    cache = PoseCache(tmp_path, (_Outer, _Inner), "code")
    written = cache.get("view-a", "key", make_value)
    read = cache.get("view-a", "key", lambda: pytest.fail("it is on disk"))
    assert np.array_equal(read.array, written.array) and read.array.dtype == written.array.dtype
    assert torch.equal(read.tensor, written.tensor) and read.tensor.dtype == torch.float16
    assert isinstance(read.inner, _Inner) and read.other is None
    assert (read.inner.name, read.inner.numbers) == ("é", (1.5, np.inf))


@pytest.mark.parametrize("change", ["key", "code", "damaged", "other type"])
def test_another_input_code_or_a_damaged_file_is_computed_anew(tmp_path: Path, change: str) -> None:
    PoseCache(tmp_path, (_Outer, _Inner), "code").get("view-a", "key", make_value)
    (file,) = (tmp_path / ".pansplat").glob("*.npz")
    if change == "damaged":
        file.write_bytes(file.read_bytes()[:-200])
    types = (_Outer,) if change == "other type" else (_Outer, _Inner)
    cache, calls = PoseCache(tmp_path, types, "other" if change == "code" else "code"), []
    replaced = _Outer(np.zeros(1), torch.zeros(1), None, None)  # type: ignore[arg-type]
    value = cache.get("view-a", "other" if change == "key" else "key", lambda: calls.append(1) or replaced)
    assert calls == [1] and value is replaced
    assert len(list((tmp_path / ".pansplat").glob("*.npz"))) == 1, "the outdated file is gone"


def test_without_a_folder_nothing_is_kept() -> None:
    values = [PoseCache(None, (), "").get("view", "", lambda: object()) for _ in range(2)]
    assert values[0] is not values[1]


def test_what_cannot_be_restored_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="cannot cache a set"):
        PoseCache(tmp_path, (), "").get("view", "", lambda: {1})


def test_hashes_depend_on_how_parts_are_divided() -> None:
    assert hash_parts("ab", "c") != hash_parts("a", "bc") and hash_parts(np.zeros(2)) != hash_parts(np.ones(2))


@pytest.mark.usefixtures("few_samples")
def test_a_further_panorama_costs_its_own_features_and_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = []
    for name in ("left", "middle", "right"):
        image = cv2.imread(str(next(SAMPLE.glob(f"{name}.*"))))
        files.append(tmp_path / f"{name}.png")
        cv2.imwrite(str(files[-1]), cv2.resize(image, (512, 256), interpolation=cv2.INTER_AREA))
    calls: list[str] = []
    for name in ("find_axes", "_estimate_pair"):
        function = getattr(estimate, name)
        monkeypatch.setattr(estimate, name, lambda *a, _f=function, _n=name, **k: calls.append(_n) or _f(*a, **k))
    first = estimate_poses(files[:2], cache_folder=tmp_path)
    assert calls.count("find_axes") == 2
    calls.clear()
    every = estimate_poses(files, cache_folder=tmp_path)
    assert calls.count("find_axes") == 1 and calls.count("_estimate_pair") <= 2 + 1, "one may be of a mirror image"
    calls.clear()
    again = estimate_poses(files, cache_folder=tmp_path)
    assert calls == [] and all(np.array_equal(again.poses[file], every.poses[file]) for file in files)
    assert set(first.poses) < set(again.poses)
