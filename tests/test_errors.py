"""Notes about the input belong to the thread that issues them; filters of warnings belong to commands."""

import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from pansplat.errors import InputWarning, collect_notes
from pansplat.images.image_files import read_size
from pansplat.system.threads import worker_threads


def warn(text: str) -> None:
    warnings.warn(text, InputWarning, stacklevel=2)


@pytest.mark.filterwarnings("ignore::pansplat.errors.InputWarning")
def test_notes_are_collected_per_thread_whatever_the_filters() -> None:
    barrier = threading.Barrier(2)

    def work(name: str) -> list[str]:
        barrier.wait()
        with collect_notes() as notes:
            for n in range(3):
                warn(f"{name} {n}")
                barrier.wait()
        warn("afterwards")
        return notes

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(work, ("first", "second"))
    assert first == [f"first {n}" for n in range(3)] and second == [f"second {n}" for n in range(3)]


@pytest.mark.filterwarnings("ignore::pansplat.errors.InputWarning")
def test_notes_of_a_pool_belong_to_the_thread_that_started_the_work() -> None:
    with worker_threads() as pool:
        with collect_notes() as notes:
            list(pool.map(warn, ("a", "b")))
            pool.submit(warn, "c").result()
        pool.submit(warn, "d").result()
    assert sorted(notes) == ["a", "b", "c"]


def test_pictures_that_two_threads_read_leave_the_filters_of_warnings(tmp_path, monkeypatch) -> None:
    Image.fromarray(np.zeros((4, 8, 3), np.uint8)).save(tmp_path / "a.png")
    first_is_inside, second_is_inside, first_is_done = (threading.Event() for _ in range(3))
    open_image = Image.open

    def open_in_turn(*arguments, **options):
        if not first_is_inside.is_set():
            first_is_inside.set()
            assert second_is_inside.wait(300)
        else:
            second_is_inside.set()
            assert first_is_done.wait(300)
        return open_image(*arguments, **options)

    monkeypatch.setattr(Image, "open", open_in_turn)
    before = list(warnings.filters)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(read_size, tmp_path / "a.png")
        assert first_is_inside.wait(300)
        second = pool.submit(read_size, tmp_path / "a.png")
        assert first.result() == (8, 4)
        first_is_done.set()
        assert second.result() == (8, 4)
    assert list(warnings.filters) == before
