"""Work in a thread, one piece after the other."""

import threading

from pansplat_viewer.scene.background import BackgroundWorker


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
