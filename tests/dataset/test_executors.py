"""The pool of processes: what its workers are started with."""

import os
import signal
import threading
import time

import pytest

from partialbench.dataset.executors import _interrupts_held_back, map_in_order, process_pool
from partialbench.errors import PartialbenchError


def born_deaf(seconds: float) -> tuple[int, bool]:
    """This worker's number, and whether SIGINT was held back from its first moment."""
    time.sleep(seconds)
    return os.getpid(), signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, set())


def test_ctrl_c_cannot_hit_any_worker_before_it_can_ignore_it():
    """Also the later ones: a pool starts each when there is work for it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, set())
    with process_pool(3) as pool:
        answers = list(pool.map(born_deaf, [1.0] * 6))
    assert len({pid for pid, _ in answers}) == 3
    assert all(deaf for _, deaf in answers)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, set()) == before


def test_ctrl_c_while_a_worker_is_started_is_heeded_right_after():
    """Whichever thread the signal reaches: the mask of one does not keep it from another."""
    elsewhere = threading.Thread(target=time.sleep, args=(1.0,))
    elsewhere.start()
    reached = []

    def interrupted() -> None:
        with _interrupts_held_back():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)
            reached.append("the end of the block")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    elsewhere.join()
    assert reached
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def threads() -> list[str | None]:
    return [os.environ.get(f"{name}_NUM_THREADS") for name in ("OMP", "OPENBLAS", "MKL")]


def test_only_the_workers_are_held_to_one_thread(monkeypatch):
    """What comes after the pool in this process, a training, has all of them."""
    for name in ("OMP", "OPENBLAS", "MKL"):
        monkeypatch.delenv(f"{name}_NUM_THREADS", raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")
    with process_pool(1) as pool:
        assert pool.submit(threads).result() == ["1", "1", "3"]
        assert threads() == [None, None, "3"]
    assert threads() == [None, None, "3"]


def slow_square(x: int) -> tuple[int, int]:
    time.sleep(0.3 / x)
    return x * x, os.getpid()


@pytest.mark.parametrize("workers", [1, 2])
def test_answers_come_in_the_order_of_the_items(workers):
    answers = list(map_in_order(slow_square, [1, 2, 3, 4], workers))
    assert [square for square, _ in answers] == [1, 4, 9, 16]
    assert ({pid for _, pid in answers} == {os.getpid()}) == (workers == 1)


def die(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_dead_worker_is_an_error_in_words():
    with pytest.raises(PartialbenchError, match=r"a worker process died.*fewer than 2 workers"):
        list(map_in_order(die, [1, 2, 3], 2))
