"""The recent paths survive a restart, and a damaged file changes nothing."""

import json
from pathlib import Path

from pansplat_viewer.window.recent import add_recent, find_file, read_recent


def test_paths_are_read_back_and_the_folder_is_made(tmp_path):
    file = tmp_path / "new" / "viewer.json"
    recent = add_recent(("/b",), Path("/a"), file)
    assert read_recent(file) == recent == (str(Path("/a").absolute()), "/b")
    assert [path.name for path in file.parent.iterdir()] == ["viewer.json"], "no temporary file is left"
    file.write_text(json.dumps({"theme": "light", "recent": ["/c"], "layout": "", "checksum": 0}))
    assert read_recent(file) == ("/c",), "a file of an earlier version"
    for text in ("", "{", "[1, 2]", '{"recent": [1, {}]}', "\x00\xff"):
        file.write_bytes(text.encode("latin-1"))
        assert read_recent(file) == (), "a damaged file"


def test_paths_that_another_window_has_opened_stay(tmp_path):
    for name in ("/a", "/b"):
        add_recent((), Path(name), tmp_path / "viewer.json")
    assert [Path(path).name for path in read_recent(tmp_path / "viewer.json")] == ["b", "a"]


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert find_file() == tmp_path / "pansplat" / "viewer.json"
    (tmp_path / "file").write_text("")
    assert add_recent((), tmp_path, tmp_path / "file" / "viewer.json") == add_recent((), tmp_path, None)
    assert read_recent(None) == ()


def test_recent_paths_are_few_different_and_the_last_one_is_first(tmp_path):
    recent = ()
    for number in [*range(15), 14, 3]:
        recent = add_recent(recent, tmp_path / str(number), None)
    assert [path.rsplit("/", 1)[1] for path in recent] == ["3", "14", *map(str, range(13, 5, -1))]
