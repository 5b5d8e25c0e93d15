"""Times of whole frames of the viewer."""

import pytest

from pansplat_viewer.window import loop_timing
from pansplat_viewer.window.loop_timing import measure_loop


@pytest.mark.gl
def test_a_flight_a_stop_and_a_turn_are_measured(ctx, room):
    times = measure_loop(room, "deferred", size=(320, 200), frames=4, repeats=1, rest_seconds=0.0)
    assert times.moving_size == (320, 200), "no image is smaller than 640x360, unless the window is"
    assert "frames per second at 320x200, sharp" in str(times)


def test_a_missing_scene_is_an_error(capsys, tmp_path):
    assert loop_timing.main([]) == 2
    assert "usage" in capsys.readouterr().err
