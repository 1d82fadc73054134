"""Objects to rows on any executor, in listing order, whatever dies meanwhile."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import BrokenExecutor, Executor, Future

from partialbench.dataset.executors import worker_deaths
from partialbench.dataset.rows import ObjectRows, failure_record, run_pickled
from partialbench.dataset.sources import ObjectRef

# Results waiting for an earlier, slower object; bounds memory and keeps every worker busy.
IN_FLIGHT_PER_WORKER = 8


def run_in_order(
    payload: bytes, refs: list[ObjectRef], make_executor: Callable[[], Executor], workers: int
) -> Generator[ObjectRows, None, None]:
    """Rows of each object in the order of ``refs``, with a bounded number in flight.

    An object whose worker process dies (a crash in native code, out of memory) is tried once more
    alone in a fresh executor; if that dies too, it is recorded as failed and the run goes on.
    """
    waiting: deque[tuple[ObjectRef, Future[ObjectRows]]] = deque()
    upcoming = iter(refs)
    executor = make_executor()
    try:
        while True:
            while len(waiting) < IN_FLIGHT_PER_WORKER * workers:
                ref = next(upcoming, None)
                if ref is None:
                    break
                waiting.append((ref, _submit(executor, payload, ref)))
            if not waiting:
                return
            ref, future = waiting.popleft()
            try:
                yield future.result()
            except worker_deaths():
                executor.shutdown(wait=False, cancel_futures=True)
                yield _alone(payload, ref, make_executor)
                executor = make_executor()
                waiting = deque(
                    (r, f if _succeeded(f) else _submit(executor, payload, r)) for r, f in waiting
                )
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _submit(executor: Executor, payload: bytes, ref: ObjectRef) -> Future[ObjectRows]:
    try:
        return executor.submit(run_pickled, payload, ref)
    except BrokenExecutor as error:
        # The pool broke between two submissions; whoever asks for the result handles it.
        broken: Future[ObjectRows] = Future()
        broken.set_exception(error)
        return broken


def _succeeded(future: Future[ObjectRows]) -> bool:
    return future.done() and not future.cancelled() and future.exception() is None


def _alone(payload: bytes, ref: ObjectRef, make_executor: Callable[[], Executor]) -> ObjectRows:
    executor = make_executor()
    try:
        return _submit(executor, payload, ref).result()
    except worker_deaths():
        reason = "the worker process died while working on it (a crash or out of memory)"
        return ObjectRows(ref.object_id, None, failures=[failure_record(ref, reason)])
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
