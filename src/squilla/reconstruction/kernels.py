"""What compiled loops over the rows of pictures share: how they are compiled, and run by threads.

A kernel works on some rows of a picture and lets go of the interpreter's lock, so that plain
threads share the rows.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

import numba
import numpy as np

compiled = numba.njit(
    fastmath={"reassoc", "contract", "nsz", "arcp"},
    error_model="numpy",
    nogil=True,
    cache=True,
)
ONE = np.float32(1)


@compiled
def add_product(vector, matrix, total):
    """Add vector @ matrix to `total`; four rows at a time keep the sums in registers."""
    rows, columns = matrix.shape
    whole = rows - rows % 4
    for i in range(0, whole, 4):
        a, b, c, d = vector[i], vector[i + 1], vector[i + 2], vector[i + 3]
        for j in range(columns):
            total[j] += (
                a * matrix[i, j]
                + b * matrix[i + 1, j]
                + c * matrix[i + 2, j]
                + d * matrix[i + 3, j]
            )
    for i in range(whole, rows):
        for j in range(columns):
            total[j] += vector[i] * matrix[i, j]


@compiled
def sigmoid(x):
    return ONE / (ONE + math.exp(-x))


def over_rows(kernel: Callable[..., None], rows: int, threads: int, *arguments) -> None:
    """Call a kernel for all rows, shared by threads."""
    # Twice as many parts as threads, since the machine may have other work; but no small ones.
    parts = min(rows // 8, 2 * threads)
    if threads == 1 or parts < 2:
        kernel(0, rows, *arguments)
        return
    edges = [rows * number // parts for number in range(parts + 1)]
    futures = [
        _pool(threads).submit(kernel, first, last, *arguments) for first, last in pairwise(edges)
    ]
    for future in futures:
        future.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="squilla-rows")
