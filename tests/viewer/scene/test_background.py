"""Work in a thread, one piece after the other."""

import threading
import time

from pansplat_viewer.scene.background import BackgroundWorker, Jobs


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


def test_jobs_of_several_names_hand_over_their_results_and_show_their_errors(wait_until):
    results, errors = [], []
    jobs = Jobs(errors.append)

    def fail(report) -> None:
        raise OSError("disk full")

    jobs.start("film", lambda report: report("drawing", 0.5) or 3, results.append)
    jobs.start("page", fail, results.append, failure="no page written: ")
    assert jobs.is_busy and jobs.progress("other") is None and not jobs.cancel("other")

    def has_ended() -> bool:
        jobs.poll()
        return not jobs.is_busy

    wait_until(has_ended, "results")
    assert results == [3] and errors == ["no page written: disk full"] and jobs.progress("film") is None
    jobs.close()


def test_a_job_that_is_cancelled_hands_over_nothing(wait_until):
    results, errors, started = [], [], threading.Event()
    jobs = Jobs(errors.append)

    def work(report) -> None:
        while True:
            report("writing", 0.2)
            started.set()
            time.sleep(0.002)

    jobs.start("film", work, results.append)
    assert started.wait(300) and jobs.progress("film") == ("writing", 0.2)
    assert jobs.cancel("film", join=True)
    jobs.poll()
    assert results == errors == [] and not jobs.is_busy
    jobs.close()
