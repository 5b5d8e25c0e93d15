"""Shared-out work is done once each, and exceptions come out when all have stopped."""

import threading
import time

import pytest

from pansplat.rendering.cpu.threads import share


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 3, 100])
def test_each_piece_is_done_once(count, threads):
    done: list[int] = []
    share(done.append, count, threads)
    assert sorted(done) == list(range(count))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_an_exception_is_raised_when_all_have_stopped(threads):
    busy = []

    def work(piece):
        busy.append(piece)
        try:
            if piece == 3:
                raise KeyboardInterrupt
            time.sleep(0.001)
        finally:
            busy.remove(piece)

    with pytest.raises(KeyboardInterrupt):
        share(work, 50, threads)
    assert busy == []
    share(work, 3, threads)  # and it can be used again


def test_two_threads_may_share_out_work_at_once():
    done: list[tuple[int, int]] = []

    def run(who):
        share(lambda piece: done.append((who, piece)), 200, 3)

    both = [threading.Thread(target=run, args=(who,)) for who in range(2)]
    for thread in both:
        thread.start()
    for thread in both:
        thread.join()
    assert sorted(done) == [(who, piece) for who in range(2) for piece in range(200)]
