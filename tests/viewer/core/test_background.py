"""Work in a thread, one piece after the other."""

import threading

import pytest

from pansplat_viewer.core.background import BackgroundWorker


def test_cancelled_work_ends_before_the_next_begins_and_work_that_waits_is_never_begun():
    worker: BackgroundWorker[None] = BackgroundWorker("worker")
    begun, released, order = threading.Event(), threading.Event(), []

    def first(report):
        begun.set()
        assert released.wait(300)
        try:
            report()
        finally:
            order.append("first has ended")

    worker.start(first)
    assert begun.wait(300)
    worker.start(lambda report: order.append("second"))
    worker.start(lambda report: order.append("third"))
    released.set()
    worker.future.result(300)
    assert order == ["first has ended", "third"]
    assert worker.cancel(join=True)
    worker.close()


def test_work_states_the_time_that_it_took_then_about_how_long_it_still_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    worker: BackgroundWorker[None] = BackgroundWorker("worker")
    assert worker.describe_time() == ""
    now, reported, released = [0.0], threading.Event(), threading.Event()
    monkeypatch.setattr("pansplat_viewer.core.background.time.monotonic", lambda: now[0])

    def work(report):
        report("working", 0.25)
        reported.set()
        assert released.wait(300)

    worker.start(work)
    assert reported.wait(300)
    texts = []
    for seconds in (1.0, 10.0, 40.0):
        now[0] = seconds
        texts.append(worker.describe_time())
    assert texts == ["1 s", "about 30 s left", "about 2 min left"]
    released.set()
    worker.close()
