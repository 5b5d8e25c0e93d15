"""The resolution follows the time budget of a moving camera, and is full at rest."""

from pansplat_viewer.draw.resolution import BUDGET_MS, SCALES, SETTLE_AFTER, AdaptiveResolution


def move_camera(resolution: AdaptiveResolution, full_ms: float, frames: int) -> list[float]:
    """Move for some frames whose time is proportional to their pixels; returns the scales."""
    scales = []
    for frame in range(frames):
        plan = resolution.plan(frame / 60, moved=True, turned=False)
        resolution.record(plan, full_ms * plan.scale**2)
        scales.append(plan.scale)
    return scales


def test_resolution_is_full_on_a_fast_machine_and_fits_the_budget_on_a_slow_one():
    assert set(move_camera(AdaptiveResolution(), BUDGET_MS / 2, 30)) == {1.0}
    scales = move_camera(AdaptiveResolution(), 5 * BUDGET_MS, 30)
    assert scales[-1] < 0.6 and 5 * BUDGET_MS * scales[-1] ** 2 <= 1.2 * BUDGET_MS
    assert move_camera(AdaptiveResolution(), 1e6, 30)[-1] == SCALES[-1]


def test_no_image_is_smaller_than_the_renderer_allows_unless_the_window_is():
    for size, smallest in (((1280, 720), 0.5), ((1920, 1080), 0.35), ((800, 600), 1.0), ((320, 200), 1.0)):
        resolution = AdaptiveResolution()
        resolution.limit(size, (640, 360))
        assert move_camera(resolution, 1e6, 30)[-1] == smallest


def test_resolution_does_not_oscillate():
    for full_ms in (60.0, 100.0, 150.0, 300.0, 700.0):
        assert len(set(move_camera(AdaptiveResolution(), full_ms, 60)[20:])) == 1


def test_resolution_rises_when_frames_get_fast_and_when_the_camera_stops():
    resolution = AdaptiveResolution()
    move_camera(resolution, 10 * BUDGET_MS, 20)
    last = 19 / 60
    assert resolution.plan(last + SETTLE_AFTER / 2, moved=False, turned=False).scale < 1
    assert resolution.plan(last + SETTLE_AFTER * 1.01, moved=False, turned=False).scale == 1
    assert move_camera(resolution, BUDGET_MS / 10, 20)[-1] == 1.0


def test_cached_faces_are_used_only_for_rotations_on_a_slow_machine():
    fast, slow = AdaptiveResolution(), AdaptiveResolution()
    fast.record(fast.plan(0, moved=False, turned=False), BUDGET_MS / 2)
    slow.record(slow.plan(0, moved=False, turned=False), BUDGET_MS * 5)
    assert not fast.plan(1, moved=False, turned=True).cached
    assert slow.plan(1, moved=False, turned=True).cached
    assert not slow.plan(1.1, moved=True, turned=False).cached
    fast.turn_ms = BUDGET_MS / 3
    assert fast.plan(2, moved=False, turned=True).cached, "reading them is faster"
