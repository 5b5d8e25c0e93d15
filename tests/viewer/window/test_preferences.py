"""The remembered values survive a restart, and a damaged file changes nothing."""

import json
from dataclasses import replace

import pytest

from pansplat_viewer.window.gui import Gui
from pansplat_viewer.window.preferences import Preferences, find_file, read_preferences, write_preferences


def test_values_are_read_back_and_the_folder_is_made(tmp_path):
    file = tmp_path / "new" / "viewer.json"
    values = Preferences("light", ("/a", "/b"), "[Window][pansplat]\nPos=0,0\n")
    write_preferences(values, file)
    assert read_preferences(file) == values
    assert [path.name for path in file.parent.iterdir()] == ["viewer.json"], "no temporary file is left"
    changed = json.loads(file.read_text())
    file.write_text(json.dumps({**changed, "layout": changed["layout"].replace("0,0", "9,9")}))
    assert read_preferences(file) == replace(values, layout=""), "a damaged layout is ignored"
    for text in ("", "{", "[1, 2]", '{"theme": 3, "recent": [1, {}], "layout": 5}', "\x00\xff"):
        file.write_bytes(text.encode("latin-1"))
        assert read_preferences(file) == Preferences(), "so is a damaged file"


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert find_file() == tmp_path / "pansplat" / "viewer.json"
    (tmp_path / "file").write_text("")
    write_preferences(Preferences("light"), tmp_path / "file" / "viewer.json")
    write_preferences(Preferences("light"), None)
    assert read_preferences(None) == Preferences()


def test_recent_paths_are_few_different_and_the_last_one_is_first(tmp_path):
    values = Preferences()
    for number in [*range(15), 14, 3]:
        values = values.add_recent(tmp_path / str(number))
    assert [path.rsplit("/", 1)[1] for path in values.recent] == ["3", "14", *map(str, range(13, 5, -1))]


@pytest.mark.gl
def test_the_layout_is_restored(ctx):
    from imgui_bundle import imgui

    def draw(gui: Gui, move: bool = False) -> tuple[float, float, float]:
        imgui.get_io().display_size = (400, 300)
        for _ in range(3):
            gui.begin(0.1, None)
            if move:
                imgui.internal.dock_builder_remove_node_docked_windows(0)
                imgui.set_next_window_pos((200, 50))
                imgui.set_next_window_size((120, 90))
                imgui.set_next_window_dock_id(0)
            imgui.begin("pansplat")
            place, width, docked = imgui.get_window_pos(), imgui.get_window_width(), imgui.is_window_docked()
            imgui.end()
            imgui.render()
        return place.x, width, docked

    gui = Gui()
    assert draw(gui) == (0, pytest.approx(240, abs=3), True), "docked at the left, 60 % of a narrow window"
    moved = draw(gui, move=True)
    assert moved == (200, 120, False)
    layout = gui.save_layout(changed=False)
    gui.close()
    again = Gui(layout=layout)
    assert draw(again) == moved
    again.reset_layout()
    assert draw(again)[0] == 0
    again.close()
