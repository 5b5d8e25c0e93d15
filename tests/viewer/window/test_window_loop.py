"""The event loop and the input devices of the window, without a display."""

from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from pansplat_viewer import app
from pansplat_viewer.core.loader import SceneEntry
from pansplat_viewer.window import window as windows
from pansplat_viewer.window.window import ContextLostError, Window, _run_loop


def make_window(**values: object) -> Mock:
    """A window of 64x32 pixels, in front of which nothing happens."""
    values = {"is_visible": True, "scale_changed": False, "dropped": [], **values}
    return Mock(spec=Window, ctx=Mock(), closing=False, framebuffer_size=(64, 32), **values)


def make_viewer() -> Mock:
    """A viewer that quits in its first frame."""
    viewer = Mock(moving=True, pending=None, state=Mock(quit=False), session=Mock(current=-1))
    viewer.frame.side_effect = lambda *_: setattr(viewer.state, "quit", True)
    return viewer


def test_a_dropped_path_is_opened_another_resolution_changes_the_scale_and_waiting_input_is_not_delayed():
    window, viewer = make_window(scale_changed=True, dpi_scale=2.0), make_viewer()
    viewer.moving, viewer.gui.has_input = False, True
    Window._drop(window, None, ["/somewhere/a pair"])
    _run_loop(window, viewer)
    viewer.session.search.assert_called_once_with(Path("/somewhere/a pair"))
    viewer.gui.set_scale.assert_called_once_with(2.0)
    window.wait.assert_called_once_with(0.0)
    assert window.dropped == [] and window.scale_changed is False


def test_a_minimised_window_waits_and_draws_nothing():
    window, viewer = make_window(is_visible=False), make_viewer()
    waits = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        window.closing = len(waits) == 3

    window.wait.side_effect = wait
    _run_loop(window, viewer)
    viewer.frame.assert_not_called()
    assert min(waits) > 0, "no busy loop"


def test_an_image_drawn_in_the_background_wakes_the_window_when_it_is_finished():
    window, viewer, pending = make_window(), make_viewer(), Future()
    viewer.pending = pending
    window.wait.side_effect = lambda seconds: pending.set_result(None)
    _run_loop(window, viewer)
    assert window.wait.call_args.args[0] > 0, "no busy loop"
    window.wake.assert_called_once_with()


def test_a_window_without_pixels_or_minimised_is_not_visible():
    for size, iconified, visible in (((640, 480), 0, True), ((640, 0), 0, False), ((640, 480), 1, False)):
        library = SimpleNamespace(
            get_framebuffer_size=lambda _, size=size: size,
            get_window_attrib=lambda _, name, value=iconified: value,
            ICONIFIED=0,
        )
        window = Window.__new__(Window)
        window._glfw, window._handle = library, None
        assert window.is_visible == visible


def test_a_reset_of_the_graphics_card_is_reported_after_the_frame():
    window = Window.__new__(Window)
    window._reset_status = lambda: 0
    window.check_context()
    window._reset_status = lambda: 0x8253  # GL_GUILTY_CONTEXT_RESET
    with pytest.raises(ContextLostError, match="graphics card was reset"):
        window.check_context()


def test_a_new_window_replaces_one_whose_context_is_lost(monkeypatch, tmp_path):
    viewers, runs = [], []

    def make(ctx: object, loader: object, **options: object) -> Mock:
        entries, opened = [SceneEntry("a"), SceneEntry("b")], tmp_path / "opened"
        viewers.append(Mock(session=Mock(entries=entries, current=1, path=opened), options=options))
        return viewers[-1]

    def run(window: object, viewer: Mock) -> None:
        runs.append(viewer)
        if len(runs) == 1:
            raise ContextLostError("reset")

    monkeypatch.setattr("pansplat_viewer.viewer.Viewer", make)
    monkeypatch.setattr(windows, "Window", Mock())
    monkeypatch.setattr(windows, "run_viewer", run)
    monkeypatch.setattr("pansplat_viewer.window.recent.find_file", lambda: tmp_path / "viewer.json")
    monkeypatch.setattr(app, "find_entries", lambda *_: [SceneEntry("a")])
    assert app._run_window(app.Options(tmp_path), (64, 32), None) is None
    first, second = viewers
    assert second.options["state"] is first.options["state"], "camera and settings"
    second.session.show.assert_called_once_with(first.session.entries, 1, tmp_path / "opened")
