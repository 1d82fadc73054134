"""Where the work runs: in this process, in a pool of processes, or on a Dask cluster.

All three are ``concurrent.futures.Executor``; the builder does not know which it was given.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from types import FrameType
from typing import Any, TypeVar

from partialbench.errors import InputError, PartialbenchError

T = TypeVar("T")
R = TypeVar("R")

# Numerical libraries read these when they load: one thread a process, or W workers would run W²
# threads. Set before a worker starts, which imports them at once.
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class InlineExecutor(Executor):
    """Runs each task at once in the calling thread: for debugging and for one worker in tests."""

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _start_worker(parent: int) -> None:
    # Ctrl-C reaches the whole process group; the parent alone decides what to do about it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries' warnings are for who wrote the file, not for who renders ten thousand of them.
    warnings.simplefilter("ignore")
    logging.getLogger().addHandler(logging.NullHandler())

    def leave_with_parent() -> None:
        # A parent killed with SIGKILL cannot tell its workers: they watch for it.
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=leave_with_parent, daemon=True).start()


@contextlib.contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Ctrl-C within the block is heeded at its end; processes started in it do not hear it at all.

    The mask is for them, who inherit it. It does not hold back this process's own handler: another
    thread takes the signal and Python runs the handler in the main thread all the same.
    """
    arrived: list[tuple[int, FrameType | None]] = []
    handler = signal.getsignal(signal.SIGINT)
    # Python's handlers run in the main thread only, and only there can they be set.
    main = threading.current_thread() is threading.main_thread()
    if callable(handler) and main:
        signal.signal(signal.SIGINT, lambda *received: arrived.append(received))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if callable(handler) and main:
            signal.signal(signal.SIGINT, handler)
            if arrived:
                handler(*arrived[0])


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started within the block compute on one thread, where the user did not say more."""
    added = [name for name in _ONE_THREAD if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        # This process has its own use for all threads: what it trains on the data, for one.
        for name in added:
            os.environ.pop(name, None)


class _Pool(ProcessPoolExecutor):
    """Starts its workers undisturbed, which it does when there is work for them.

    Ctrl-C must not hit a worker before it can ignore it, nor this process between starting a worker
    and writing it down: one the pool does not know would never be told to leave.
    """

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        with _interrupts_held_back(), _one_thread_each():
            return super().submit(fn, *args, **kwargs)


def process_pool(workers: int) -> ProcessPoolExecutor:
    """``workers`` spawned processes of one thread each.

    Spawned, not forked: Dr.Jit and BLAS keep threads and locks that a fork would copy mid-air.
    """
    if workers < 1:
        raise InputError(f"--workers must be at least 1, got {workers}")
    return _Pool(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(os.getpid(),),
    )


def map_in_order(
    fn: Callable[[T], R], items: Sequence[T], workers: int, chunksize: int = 1
) -> Iterator[R]:
    """``fn`` of each item, in the items' order, as they are done; in this process with one worker.

    Raises:
        PartialbenchError: a worker died, mostly for want of memory.
    """
    workers = min(workers, len(items))
    if workers <= 1:
        yield from map(fn, items)
        return
    try:
        with process_pool(workers) as pool:
            yield from pool.map(fn, items, chunksize=chunksize)
    except BrokenExecutor as error:
        raise PartialbenchError(
            f"a worker process died, perhaps for want of memory; try fewer than {workers} workers"
        ) from error


class DaskExecutor(Executor):
    """A Dask client as an executor that owns it: shutting down cancels and disconnects."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.workers = sum(client.nthreads().values())
        # pure=False: a task is known by its own key, never looked up by its arguments.
        self._executor = client.get_executor(pure=False)

    def submit(self, fn: Callable, /, *args: Any, **kwargs: Any) -> Future:
        return self._executor.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        # Dask's own executor cancels what is pending when it does not wait.
        self._executor.shutdown(wait=wait and not cancel_futures)
        self._client.close()


def dask_cluster(address: str, timeout_s: float = 20) -> DaskExecutor:
    """An executor on the Dask scheduler at ``address``; ``workers`` says how many threads it has.

    Raises:
        InputError: ``distributed`` is not installed, nobody answers, or there are no workers.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise InputError(
            "--scheduler needs Dask's distributed: pip install 'partialbench[cluster]'"
        ) from error
    try:
        client = Client(address, timeout=timeout_s)
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address!r}: {error}") from error
    try:
        # A worker that just died is being restarted by its nanny.
        client.wait_for_workers(1, timeout=30)
    except TimeoutError as error:
        client.close()
        raise InputError(
            f"the scheduler at {address!r} has no workers; start some with 'dask worker {address}'"
        ) from error
    return DaskExecutor(client)


def worker_deaths() -> tuple[type[BaseException], ...]:
    """The exceptions by which the executors in use say that a worker died."""
    distributed = sys.modules.get("distributed")
    return (BrokenExecutor, distributed.KilledWorker) if distributed else (BrokenExecutor,)
