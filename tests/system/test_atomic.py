"""A file that is replaced: what is at its path before stays, or becomes the new content."""

from pathlib import Path

import pytest

from pansplat.system.atomic import replacing
from pansplat.system.store import write_cache_file


def test_a_link_to_a_file_stays_and_the_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    file, link = tmp_path / "shared" / "poses.json", tmp_path / "poses.json"
    file.write_text("before")
    link.symlink_to("shared/poses.json")
    with pytest.raises(ZeroDivisionError), replacing(link) as unfinished:
        unfinished.write_text("half")
        1 / 0  # noqa: B018
    assert file.read_text() == "before"
    with replacing(link) as unfinished:
        unfinished.write_text("after")
    assert link.is_symlink() and file.read_text() == "after" and not file.is_symlink()
    assert [*(tmp_path / "shared").iterdir()] == [file]


def test_no_link_of_a_folder_chooses_where_a_new_file_or_an_entry_of_the_cache_is_written(tmp_path: Path) -> None:
    outside, link = tmp_path / "outside", tmp_path / "folder" / "links.json"
    link.parent.mkdir()
    link.symlink_to(outside)
    with replacing(link) as unfinished:
        unfinished.write_text("new")
    assert not outside.exists() and link.read_text() == "new" and not link.is_symlink()
    outside.write_text("of the user")
    (link.parent / "a.entry").symlink_to(outside)
    written = write_cache_file([link.parent], "a.entry", b"entry")
    assert written is not None and written.read_bytes() == b"entry" and outside.read_text() == "of the user"
