"""Times of whole frames of the viewer."""

import pytest

from pansplat_viewer.window import loop_timing
from pansplat_viewer.window.loop_timing import LoopTimes, measure_loop


@pytest.mark.gl
def test_a_flight_a_stop_and_a_turn_are_measured(ctx, room):
    times = measure_loop(room, "deferred", size=(320, 200), frames=4, repeats=1, rest_seconds=0.0)
    assert times.moving_size == (320, 200), "no image is smaller than 640x360, unless the window is"


def test_times_are_printed_as_rates():
    text = str(LoopTimes(40.0, (640, 360), 0.123, 10.0))
    assert text.startswith("moving 25.0 frames per second at 640x360, sharp 0.12 s") and "turning 100.0" in text


def test_a_missing_scene_is_an_error(capsys, tmp_path):
    assert loop_timing.main([]) == 2
    assert "usage" in capsys.readouterr().err
