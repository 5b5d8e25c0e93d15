"""Moving is fluent, standing still is sharp."""

from pansplat_viewer.viewer import BUDGET_MS, REFINE_AFTER, SCALES, AdaptiveResolution


def run(
    pacer: AdaptiveResolution, full_ms: float, frames: int, *, moved: bool = True, start: float = 0.0
) -> list[float]:
    scales = []
    for frame in range(frames):
        plan = pacer.plan(start + frame / 60, moved=moved, turned=not moved)
        pacer.record(plan, full_ms * plan.scale**2)
        scales.append(plan.scale)
    return scales


def test_a_fast_machine_never_goes_coarse():
    assert set(run(AdaptiveResolution(), BUDGET_MS / 2, 30)) == {1.0}


def test_a_slow_machine_goes_coarse_until_the_budget_fits():
    scales = run(AdaptiveResolution(), 5 * BUDGET_MS, 30)
    assert scales[-1] < 0.6 and 5 * BUDGET_MS * scales[-1] ** 2 <= 1.2 * BUDGET_MS


def test_the_coarsest_scale_is_the_end():
    assert run(AdaptiveResolution(), 1e6, 30)[-1] == SCALES[-1]


def test_resolution_does_not_breathe():
    for full in (60.0, 100.0, 150.0, 300.0, 700.0):
        assert len(set(run(AdaptiveResolution(), full, 60)[20:])) == 1


def test_resolution_comes_back_when_frames_get_fast():
    pacer = AdaptiveResolution()
    run(pacer, 20 * BUDGET_MS, 20)
    assert run(pacer, BUDGET_MS / 10, 20)[-1] == 1.0


def test_standing_still_refines_to_full_resolution():
    pacer = AdaptiveResolution()
    run(pacer, 10 * BUDGET_MS, 20)
    last = 19 / 60
    assert pacer.plan(last + REFINE_AFTER / 2, moved=False, turned=False).scale < 1
    assert pacer.plan(last + REFINE_AFTER * 1.01, moved=False, turned=False).scale == 1


def test_only_a_slow_machine_that_only_turns_looks_up_cached_faces():
    fast, slow = AdaptiveResolution(), AdaptiveResolution()
    fast.record(fast.plan(0, moved=False, turned=False), BUDGET_MS / 2)
    slow.record(slow.plan(0, moved=False, turned=False), BUDGET_MS * 5)
    assert not fast.plan(1, moved=False, turned=True).cached
    assert slow.plan(1, moved=False, turned=True).cached
    assert not slow.plan(1.1, moved=True, turned=False).cached


def test_adaption_can_be_switched_off():
    pacer = AdaptiveResolution()
    run(pacer, 10 * BUDGET_MS, 20)
    assert pacer.plan(0.5, moved=True, turned=False, adaptive=False).scale == 1
