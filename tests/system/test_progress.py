"""Progress in stages, which lies between their fractions of the whole."""

import threading
from contextvars import copy_context

import pytest

from pansplat.system.progress import is_progress_shown, report_progress, show_progress, stage
from pansplat.system.threads import worker_threads


def test_stages_of_stages_are_between_their_fractions_of_the_whole() -> None:
    calls: list[tuple[str, float]] = []
    with show_progress(lambda *call: calls.append(call)):
        with stage(0.5):
            report_progress("poses", 0.5)
        with stage(1.0, "room: "), stage(0.4):
            report_progress("searching", 0.5)
    assert calls == [("poses", 0.25), ("room: searching", pytest.approx(0.6))]


def test_a_stage_without_work_leaves_its_share_to_the_next_one() -> None:
    fractions: list[float] = []
    with show_progress(lambda _, done: fractions.append(done)):
        with stage(0.5):  # nothing is reported
            pass
        with stage():
            report_progress("predicting", 0.25)
    assert fractions == [0.25]


def test_the_fraction_of_the_whole_never_falls_and_ends_at_one() -> None:
    fractions: list[float] = []
    with show_progress(lambda _, done: fractions.append(done)):
        for end in (0.6, 0.3, 0.9, 1.0):
            with stage(end):
                for done in (0.0, 0.7, 0.2, 3.0):
                    report_progress("", done)
    assert fractions == sorted(fractions) and fractions[-1] == 1.0


def test_work_that_nobody_shows_reports_nothing_and_an_error_ends_the_stages() -> None:
    def cancel(what: str, done: float) -> None:
        raise KeyboardInterrupt

    report_progress("searching", 0.5)
    with pytest.raises(KeyboardInterrupt), show_progress(cancel), stage(0.5):
        report_progress("searching", 0.5)
    assert not is_progress_shown()


def test_a_pool_of_worker_threads_and_copied_contexts_report_to_the_same_whole() -> None:
    calls: list[tuple[str, float]] = []
    with show_progress(lambda *call: calls.append(call)), stage(0.5), worker_threads() as pool:
        pool.submit(report_progress, "pool", 0.5).result()
        thread = threading.Thread(target=copy_context().run, args=(report_progress, "thread", 1.0))
        thread.start()
        thread.join()
    assert calls == [("pool", 0.25), ("thread", 0.5)]


@stage()
def _predict() -> None:
    report_progress("predicting", 0.5)


def test_a_function_can_be_a_stage_of_each_of_its_callers() -> None:
    fractions: list[float] = []
    with show_progress(lambda _, done: fractions.append(done)):
        for number in (1, 2):
            with stage(number / 2):
                _predict()
    assert fractions == [0.25, 0.75]
