"""Entries of the store: each kind is read as it was written, and a damaged one is computed again."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pansplat.errors import InputWarning
from pansplat.system import store
from pansplat.system.atomic import replacing
from pansplat.system.store import Store, hash_file, hash_parts


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


TYPES = (_Outer, _Inner)
VALUES: dict[str, Callable[[], Any]] = {
    "arrays": lambda: _Outer(
        np.arange(6.0).reshape(2, 3)[:, ::-1], torch.ones(2, 2, dtype=torch.float16), _Inner("é", (1.5, np.inf)), None
    ),
    "no numbers": lambda: _Outer(np.zeros((), np.uint8), torch.zeros(0, 3, dtype=torch.bool), _Inner("", ()), None),
    "json": lambda: {"worlds": [{"near": 0.5, "poses": {"$tensor": [[1.0, 0.0]]}}], "unplaced": {}, "\udcff": None},
}


def describe(value: Any) -> Any:
    """A value in a form that can be compared."""
    if isinstance(value, (np.ndarray, torch.Tensor)):
        return type(value), value.dtype, tuple(value.shape), np.asarray(value).tolist()
    if isinstance(value, (tuple, list)):
        return type(value), [describe(each) for each in value]
    return [type(value), *map(describe, vars(value).values())] if hasattr(value, "__dict__") else value


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache folder is `home` in the same temporary folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(store, "_used", set())
    (tmp_path / "photographs").mkdir()
    return tmp_path / "photographs"


def fail() -> None:
    pytest.fail("it is in the store")


@pytest.mark.parametrize("value", VALUES)
def test_an_entry_is_read_as_it_was_written(folder: Path, value: str) -> None:
    written = Store(folder, TYPES).get("view", "key", VALUES[value])
    assert describe(Store(folder, TYPES).get("view", "key", fail)) == describe(written)
    assert len(list((folder / ".pansplat").iterdir())) == 1


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "other"])
def test_a_damaged_entry_is_computed_again_with_a_note(folder: Path, value: str, damage: str) -> None:
    Store(folder, TYPES).get("view", "key", VALUES[value])
    (file,) = (folder / ".pansplat").iterdir()
    content = file.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 4
    damaged = {"truncated": content[:-9], "flipped": bytes(flipped), "empty": b"", "other": b"x" * 99}
    file.write_bytes(damaged[damage])
    with pytest.warns(InputWarning, match=r"\.entry is damaged, and is computed again"):
        assert Store(folder, TYPES).read("view", "key") is None
    Store(folder, TYPES).write("view", "key", VALUES[value]())
    assert file.read_bytes() == content


def test_another_key_or_kind_has_another_entry(folder: Path) -> None:
    entries = Store(folder)
    names = [(kind, key) for kind in ("view", "pair") for key in ("1", "2")]
    for name in names:
        entries.get(*name, lambda name=name: list(name))
    assert [entries.get(*name, fail) for name in names] == list(map(list, names))
    assert sorted(entries.list_values("pair")) == [["pair", "1"], ["pair", "2"]]


def test_what_cannot_be_written_to_the_folder_is_in_the_users_cache_or_kept_until_the_end(folder, tmp_path) -> None:
    (folder / ".pansplat").write_text("")  # unwritable, for root too
    Store(folder).get("view", "key", lambda: 1)
    assert Store(folder).get("view", "key", fail) == 1 and len(list((tmp_path / "home").rglob("*.entry"))) == 1
    for each in (tmp_path / "home").rglob("*.entry"):
        each.unlink()
    os.rename(tmp_path / "home", tmp_path / "old")
    (tmp_path / "home").write_text("")
    for entries, values in ((Store(folder), [2, 2]), (Store(None), [2, 3])):
        assert [entries.get("view", "key", lambda n=n: n) for n in (2, 3)] == values
    code = (
        "import sys\nfrom pathlib import Path\nfrom pansplat.system.store import Store\n"
        "store = Store(Path(sys.argv[1]))\nstore.write('view', 'a', 1)\n(file,) = store.find('view', 'a')\n"
        "assert store.read('view', 'a') == 1\nprint(file, oct(file.parents[1].stat().st_mode))"
    )
    result = subprocess.run([sys.executable, "-c", code, folder], capture_output=True, text=True, check=True)
    file, mode = result.stdout.split()
    assert mode == "0o40700" and folder not in Path(file).parents and not Path(file).parents[1].exists()


def test_what_cannot_be_restored_is_not_written(folder: Path) -> None:
    with pytest.raises(TypeError, match="cannot store a set"):
        Store(folder).get("view", "", lambda: {1})
    assert not (folder / ".pansplat").exists()


def test_the_entries_that_were_used_least_recently_are_removed_above_the_limit_and_none_in_use(folder, monkeypatch):
    entries = Store(folder)

    def add(key: str) -> Path:
        entries.write("view", key, np.zeros(1000))
        return entries.find("view", key)[0]

    files = [add(key) for key in "abcd"]
    monkeypatch.setattr(store, "LIMIT", 3 * files[0].stat().st_size)
    (folder / ".pansplat" / "kept.cube.json").write_bytes(bytes(10_000))
    for number, file in enumerate(files):
        os.utime(file, (1e9 + number, 1e9 + number))
    add("e")
    assert all(file.exists() for file in files)
    monkeypatch.setattr(store, "_used", set())  # as in another process
    entries.read("view", "a")
    os.utime(files[2])  # read by another process
    add("f")
    assert [file.exists() for file in files] == [True, False, True, False], "a is used here, c by another process"
    assert (folder / ".pansplat" / "kept.cube.json").exists(), "it stands for a photograph"


def test_unfinished_files_of_killed_processes_are_removed(folder: Path) -> None:
    cache, unfinished = folder / ".pansplat", []
    cache.mkdir()
    for name in ("old.entry", "new.entry"):
        with pytest.raises(KeyboardInterrupt), replacing(cache / name) as file:
            unfinished.append(file)
            raise KeyboardInterrupt
    old, new = unfinished
    for file in unfinished:
        file.write_bytes(b"half")  # the content after a process that was killed while it wrote
    os.utime(old, (1e9, 1e9))
    Store(folder).write("view", "key", 1)
    assert set(cache.iterdir()) == {new, *Store(folder).find("view", "key")}


def test_two_processes_share_a_folder(folder: Path) -> None:
    """Each writes, reads and removes entries that the other one reads."""
    code = (
        "import sys, pathlib, numpy\nfrom pansplat.system import store\n"
        "store.LIMIT, store._IN_USE_SECONDS = 20_000, -1.0\n"
        "for n in range(60):\n"
        "    store._used.clear()\n"
        "    value = store.Store(pathlib.Path(sys.argv[1])).get('view', str(n % 5), lambda: numpy.full(900, n % 5))\n"
        "    assert (value == n % 5).all()\n"
    )
    command = [sys.executable, "-W", "error", "-c", code, str(folder)]
    running = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    assert [(process.communicate()[1], process.returncode) for process in running] == [("", 0)] * 2


def test_the_hash_of_a_file_is_that_of_its_bytes(tmp_path: Path) -> None:
    file, copy = tmp_path / "a.jpg", tmp_path / "b.jpg"
    for path in (file, copy):
        path.write_bytes(b"1234")
    os.utime(copy, (1e9, 1e9))
    before = hash_file(file)
    assert before == hash_file(copy)
    state = file.stat()
    file.write_bytes(b"1235")
    os.utime(file, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert hash_file(file) != before, "of the same size and time"


def test_hashes_depend_on_how_parts_are_divided() -> None:
    assert hash_parts("ab", "c") != hash_parts("a", "bc") and hash_parts(np.zeros(2)) != hash_parts(np.ones(2))
