"""The stop-watch of the benchmarks: how long a call takes once it is warm."""

import time
from collections.abc import Callable
from statistics import median


def seconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Return the median time of a call after one to warm up, s."""
    call()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return median(taken)
