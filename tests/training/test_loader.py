"""Batches are determined by seed and step; unreadable samples are skipped, and named once."""

import itertools
import json
from pathlib import Path

import pytest
import torch
from refusals import expect_error

from pansplat.errors import InputError
from pansplat.images.image_files import write_image
from pansplat.inputs.views import Batch
from pansplat.training.loader import Loader
from pansplat.training.sources import PairSource, read_game_maps


def _triplets(folder: Path, count: int) -> PairSource:
    for k in range(count):
        for i in range(3):
            write_image(folder / f"{k}_{i}.png", torch.full((3, 8, 16), (3 * k + i) / 40))
        poses = [[[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, k], [0, 0, 0, 1]] for i in range(3)]
        (folder / f"{k}.json").write_text(json.dumps({"c2w": poses}))
    return read_game_maps(folder)


def _take(loader: Loader, count: int, step: int = 0) -> list[Batch]:
    return list(itertools.islice(loader.batches(step), count))


def _equal(first: list[Batch], second: list[Batch]) -> bool:
    return all(
        a.names == b.names and torch.equal(a.images, b.images) and torch.equal(a.cam2world, b.cam2world)
        for a, b in zip(first, second, strict=True)
    )


def test_each_epoch_is_a_permutation_of_all_samples(tmp_path: Path) -> None:
    loader = Loader(_triplets(tmp_path, 6), height=8, batch_size=2)
    names = [name for batch in _take(loader, 9) for name in batch.names]
    epochs = [names[6 * k : 6 * k + 6] for k in range(3)]
    assert all(sorted(epoch) == [str(k) for k in range(6)] for epoch in epochs)
    assert len(set(map(tuple, epochs))) > 1


def test_batches_from_a_step_equal_those_of_an_uninterrupted_run(tmp_path: Path) -> None:
    loader = Loader(_triplets(tmp_path, 5), height=8, batch_size=2, seed=3, augmentation=True)
    whole = _take(loader, 7)
    assert _equal(_take(loader, 3, step=4), whole[4:])
    assert not _equal(_take(loader, 3, step=3), whole[4:])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # on one core
def test_batches_do_not_depend_on_the_number_of_workers(tmp_path: Path) -> None:
    source = _triplets(tmp_path, 5)
    options = {"height": 8, "batch_size": 2, "seed": 1, "augmentation": True}
    alone = _take(Loader(source, **options), 3)
    assert _equal(_take(Loader(source, workers=2, **options), 3), alone)
    assert not _equal(_take(Loader(source, **(options | {"seed": 2})), 3), alone)


def test_unreadable_samples_are_skipped_and_named_once(tmp_path: Path) -> None:
    source = _triplets(tmp_path, 6)
    (tmp_path / "2_1.png").write_bytes(b"")
    (tmp_path / "4_0.png").write_bytes((tmp_path / "4_0.png").read_bytes()[:40])
    loader = Loader(source, height=8, batch_size=3)
    with pytest.warns(UserWarning, match="skipped a sample") as caught:
        batches = _take(loader, 4)
    assert all(len(batch) == 3 for batch in batches)
    assert not {"2", "4"} & {name for batch in batches for name in batch.names}
    assert len(caught) == 2 and any("2_1.png" in str(w.message) for w in caught)
    assert sorted(message.split(":")[0].rsplit("/")[-1] for message in loader.skipped) == ["2_1.png", "4_0.png"]
    with pytest.warns(UserWarning):
        assert _equal(_take(Loader(source, height=8, batch_size=3), 2, step=2), batches[2:])


def test_an_error_names_files_when_all_samples_are_unreadable(tmp_path: Path) -> None:
    source = _triplets(tmp_path, 4)
    for path in tmp_path.glob("*_1.png"):
        path.write_bytes(b"")
    with (
        pytest.warns(UserWarning, match="skipped"),
        pytest.raises(InputError, match=r"got 4 consecutive unreadable ones \(of 4\).*_1\.png"),
    ):
        _take(Loader(source, height=8, batch_size=1), 1)


def test_empty_sources_and_batches_are_refused(tmp_path: Path) -> None:
    expect_error("empty source", lambda: Loader([], height=8, batch_size=1))
    expect_error("batch_size >= 1", lambda: Loader(_triplets(tmp_path, 1), height=8, batch_size=0))
