"""Who does the tasks: this process, processes of this machine, or a Dask cluster."""

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from squilla.errors import InputError


@dataclass(frozen=True)
class Crew:
    """An executor, and how many tasks to hand to it at once."""

    executor: Executor
    most: int

    def do(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """Have one task done, and wait for it."""
        return self.executor.submit(work, *arguments).result()

    def each(
        self, work: Callable[..., Any], tasks: Iterable[tuple[str, tuple]]
    ) -> Iterator[tuple[str, Any]]:
        """Have tasks done; yield the name of each and what it gave, in the order of their ends.

        Parameters
        ----------
        work : function
        tasks : iterable of (name, arguments)
        """
        waiting, running = iter(tasks), {}
        while True:
            # A few at a time: thousands of tasks in line would only take memory.
            while len(running) < self.most and (task := next(waiting, None)) is not None:
                name, arguments = task
                running[self.executor.submit(work, *arguments)] = name
            if not running:
                return
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                yield running.pop(future), future.result()


@contextmanager
def crew(tasks: int, workers: int | None, scheduler: str | None) -> Iterator[Crew]:
    """Lend a crew.

    Parameters
    ----------
    tasks : int
        How many there will be.
    workers : int or None
        Processes; None for one on each core. 1 stays in this process.
    scheduler : str or None
        Address of a Dask scheduler instead.

    Raises
    ------
    InputError
        If no scheduler answers or it has no workers, or a process of this machine dies.
    """
    workers = min(workers or len(os.sched_getaffinity(0)), tasks)
    if scheduler is not None:
        with _cluster(scheduler) as lent:
            yield lent
    elif workers <= 1:
        yield Crew(_Here(), 1)
    else:
        with _processes(workers) as lent:
            yield lent


class _Here(Executor):
    """Does each task in this process, when it is submitted."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextmanager
def _cluster(scheduler: str) -> Iterator[Crew]:
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "A scheduler needs Dask; install it with: pip install 'squilla[batch]'."
        ) from error
    try:
        client: Any = Client(scheduler, timeout=20, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"No Dask scheduler answers at {scheduler}: {error}") from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise InputError(f"The scheduler at {scheduler} has no workers yet; start some.")
        yield Crew(client.get_executor(pure=False), 2 * threads)


@contextmanager
def _processes(count: int) -> Iterator[Crew]:
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_alone)
    try:
        yield Crew(pool, 2 * count)
    except BrokenProcessPool as error:
        raise InputError(
            "A worker died, probably for lack of memory; run again, with fewer workers, to go on."
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let one task take one thread: sums then come out the same wherever it is worked on."""
    import numba
    import torch

    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])


def _alone() -> None:
    """Make a process of this machine a worker that ends with the run, and not before."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run above is interrupted, and ends us
    threading.Thread(target=_follow_the_run, daemon=True).start()


def _follow_the_run() -> None:
    """End this process when the one that started it has been killed; pools do not."""
    from multiprocessing import parent_process

    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
