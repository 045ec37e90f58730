"""The stop-watch of the benchmarks: how long a call takes once it is warm."""

import time
from collections.abc import Callable
from statistics import median


def times(call: Callable[[], object], repeats: int, *, warm: int = 1) -> list[float]:
    """Return what each of some calls took, s, after a few to warm up."""
    for _ in range(warm):
        call()
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return taken


def seconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Return the median time of a call after one to warm up, s."""
    return median(times(call, repeats))
