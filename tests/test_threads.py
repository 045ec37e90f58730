"""Products of matrices on one thread: in whichever thread they are wished so, and no longer."""

from threading import Event, Thread

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from squilla.threads import single_threaded_products


def limits() -> set[int]:
    """Return how many threads the BLAS libraries may use."""
    np.linalg.inv(np.eye(2))
    return {info["num_threads"] for info in ThreadpoolController().info()
            if info["user_api"] == "blas"}  # fmt: skip


@pytest.fixture
def two():
    """Let BLAS have two threads."""
    with threadpool_limits(2, "blas"):
        if limits() != {2}:
            pytest.skip("this BLAS has no threads")
        yield


def test_one_thread_after_the_other(two):
    seen = []

    @single_threaded_products()
    def look():
        seen.append(limits())

    look()
    for _ in range(2):
        thread = Thread(target=look)
        thread.start()
        thread.join()
        seen.append(limits())
    assert seen == [{1}, {1}, {2}, {1}, {2}]


def test_threads_that_overlap(two):
    entered, left, seen = Event(), Event(), []

    def first():
        with single_threaded_products():
            entered.set()
            left.wait(10)

    thread = Thread(target=first)
    thread.start()
    entered.wait(10)
    with single_threaded_products():
        left.set()
        thread.join()
        seen.append(limits())  # the first is gone, this wish stands
    seen.append(limits())
    assert seen == [{1}, {2}]
