"""One set of threads at a time: products of matrices keep out of the way of compiled loops.

BLAS libraries let their threads spin for some milliseconds after a product, to be ready for the
next one. Loops that follow on threads of their own then get half of the cores: between them, a
small product on two threads costs more than a large one on a single thread.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial
from threading import Lock
from typing import Any


class _Blas:
    """The BLAS libraries of this process, and how many want them on one thread."""

    def __init__(self) -> None:
        import scipy.linalg.cython_blas  # noqa: F401  # where compiled loops have theirs from
        from threadpoolctl import OpenBLASController, ThreadpoolController

        self.lock, self.wishes = Lock(), 0
        # Only the thread that first set a limit may set another, were it not for this.
        self.free = partial(OpenBLASController.clear_controlling_thread, force=True)
        self.libraries = ThreadpoolController().select(user_api="blas")
        self.limit: Any = None


@cache
def _blas() -> _Blas:
    return _Blas()


@contextmanager
def single_threaded_products() -> Iterator[None]:
    """Let every product of matrices in this process take one thread, for as long as it lasts.

    Several threads may wish so at once. Serves as a decorator too.
    """
    blas = _blas()
    with blas.lock:
        if not blas.wishes:
            blas.free()
            blas.limit = blas.libraries.limit(limits=1)
        blas.wishes += 1
    try:
        yield
    finally:
        with blas.lock:
            blas.wishes -= 1
            if not blas.wishes:
                blas.free()
                blas.limit.restore_original_limits()
