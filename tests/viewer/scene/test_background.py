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

    last_begun = threading.Event()
    worker.start(first)
    assert begun.wait(300)
    worker.start(lambda report: order.append("second"))
    worker.start(lambda report: (last_begun.set(), order.append("third"))[1])
    assert not last_begun.wait(0.2)
    released.set()
    worker.future.result(300)
    assert order == ["first has ended", "third"]
    worker.close()


def test_joining_waits_for_all_cancelled_work():
    worker: BackgroundWorker[None] = BackgroundWorker("worker")
    begun, order = threading.Event(), []

    def first(report):
        begun.set()
        while not worker_is_joining.wait(0.01):
            pass
        order.append("first has ended")

    worker_is_joining = threading.Event()
    worker.start(first)
    assert begun.wait(300)
    worker.start(lambda report: order.append("second"))
    threading.Timer(0.5, worker_is_joining.set).start()
    assert worker.cancel(join=True)
    assert order == ["first has ended"]
    worker.close()
