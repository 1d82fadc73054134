"""When a training is saved and when it stops: time, a deadline, Ctrl-C, in all processes alike."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

import torch
from lightning.fabric import Fabric

from partialbench.benchmark.training.loop import CHECK_EVERY, Loop
from partialbench.errors import TimeLimitError

CHECKPOINT_SECONDS = 180.0
"""How much wall time a training that is killed may lose."""


class Keeper:
    """Decides after each step whether to save, and whether to stop; several processes agree.

    While it is entered, Ctrl-C waits for the step under way; a second one does not.
    """

    GO_ON, SAVE, TIME_IS_OVER, INTERRUPTED = range(4)

    def __init__(
        self,
        fabric: Fabric,
        loop: Loop,
        checkpoint_every: int | None,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self.fabric, self.loop = fabric, loop
        self.checkpoint_every, self.should_stop = checkpoint_every, should_stop
        self.saved_at, self.interrupted = time.monotonic(), False
        self.before: Any = None

    def __enter__(self) -> Keeper:
        if threading.current_thread() is threading.main_thread():
            self.before = signal.getsignal(signal.SIGINT)
            if callable(self.before):
                signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if callable(self.before):
            signal.signal(signal.SIGINT, self.before)
        if self.interrupted and kind is None:
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = True
        signal.signal(signal.SIGINT, self.before)

    def _wish(self) -> int:
        time_is_over = self.should_stop is not None and self.should_stop()
        if self.interrupted:
            return self.INTERRUPTED
        if time_is_over:
            return self.TIME_IS_OVER
        if time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
            return self.SAVE
        return self.GO_ON

    def after_step(self, save: Callable[[], None]) -> None:
        """Calls ``save`` where it is time, and raises where it is over."""
        step, wish = self.loop.step, self.GO_ON
        if self.fabric.world_size == 1:
            wish = self._wish()
        elif step % CHECK_EVERY == 0:
            mine = torch.tensor(self._wish(), device=self.fabric.device)
            wishes = self.fabric.all_gather(mine)
            assert isinstance(wishes, torch.Tensor)
            wish = int(wishes.max())
        if self.checkpoint_every is not None and step % self.checkpoint_every == 0:
            wish = max(wish, self.SAVE)
        if wish == self.GO_ON:
            return
        save()
        self.saved_at = time.monotonic()
        if wish == self.INTERRUPTED:
            raise KeyboardInterrupt
        if wish == self.TIME_IS_OVER:
            raise TimeLimitError(
                f"out of time: {self.loop.task.model} is saved at {self.loop.clouds_seen:,} of "
                f"{self.loop.plan.clouds_seen:,} clouds; the same call goes on from there"
            )
