"""``partialbench campaign run``: does what is missing, several jobs side by side."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any

from partialbench import registry
from partialbench.benchmark.campaign.choice import Choice, choose
from partialbench.benchmark.campaign.data import digests, is_rendered
from partialbench.benchmark.campaign.declare import declare
from partialbench.benchmark.campaign.failures import (
    Failures,
    failure_key,
    keys_of,
    training_key,
)
from partialbench.benchmark.campaign.file import Campaign, DataSet
from partialbench.benchmark.campaign.jobs import Job, all_jobs, json_text
from partialbench.benchmark.campaign.ledger import Ledger
from partialbench.benchmark.campaign.status import HEARTBEAT_S, RUNNING, Status, status
from partialbench.benchmark.campaign.worker import (
    DIVERGED,
    DONE,
    FAILED,
    KILLED,
    STOPPED,
    run_in_process,
)
from partialbench.benchmark.records.results import file_name
from partialbench.dataset.executors import dask_cluster
from partialbench.dataset.lock import sole_user
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError, PartialbenchError, TimeLimitError

log = logging.getLogger(__name__)

LEAST_FREE_BYTES = 500_000_000
"""With less room on the disk no job is begun: it could not save what it learns."""
MARGIN_S = 20.0
"""Kept of a time limit for saving and leaving."""


def run(
    campaign: Campaign,
    *,
    jobs: int | None = None,
    device: str = "auto",
    only: Sequence[str] = (),
    up_to: str | int | None = None,
    trials: bool = True,
    time_limit_s: float | None = None,
    scheduler: str | None = None,
    retry_failed: bool = False,
    say: Callable[[str], None] = log.info,
) -> Status:
    """Renders what data are missing, trains what rows are behind, and makes the board.

    Args:
        jobs: how many side by side; by default one a core, on CUDA one.
        only: patterns of model names, "papnet*", or of model and data set, "papnet*@pm40-clouds";
            all without one. Of one milestone, jobs that fit an earlier pattern are begun first.
        up_to: the last milestone that is trained to, as ``milestones.parse`` takes it; by default
            the file's last.
        trials: also those that the file's [[tune]] ask for.
        time_limit_s: after so long every training saves its state and the campaign ends.
        scheduler: of a Dask cluster whose workers see the same folders; ``jobs`` is then by default
            as many as it has threads.
        retry_failed: try jobs again that are recorded as failed, of those that are asked for.
        say: told in one line what begins, what ended and how much is to go.

    Returns:
        where the campaign stands at its end.

    Raises:
        TimeLimitError: the time was over before the work was.
        InputError: options that a model does not have, or not as the file has them; or what is
            asked for is nothing of the file's.
        PartialbenchError: another campaign works in the folder, the disk is full, data that cannot
            be rendered or are not what the file declares.
    """
    _check_options(campaign)
    choice = choose(only, up_to, trials)
    choice.require_some(campaign)
    campaign.results.mkdir(parents=True, exist_ok=True)
    deadline = None if time_limit_s is None else time.monotonic() + time_limit_s - MARGIN_S
    with sole_user(campaign.work, "working on", "give it a folder of its own"):
        if retry_failed:
            # What is left out keeps its record: it is not tried now.
            tried = filter(choice.has, all_jobs(campaign))
            Failures(campaign).forget({key for job in tried for key in keys_of(job)})
        runner = _Runner(campaign, choice, device, deadline, say)
        try:
            with _executor(scheduler, jobs, device) as (executor, width):
                runner.render(width, scheduler)
                ended = runner.work(executor, width)
        finally:
            runner.forget()
        if campaign.board is not None and any(campaign.results.glob("*.result.json")):
            make = registry.load(registry.LEADERBOARD)
            parents = dict.fromkeys(data.folder.parent for data in campaign.data.values())
            look_in = [parent for parent in parents if parent.is_dir()]
            for path in make(campaign.results, campaign.board, look_in=look_in):
                log.info("wrote %s", path)
        if runner.unrendered:
            raise PartialbenchError(
                f"all was done but for {len(runner.unrendered)} data set(s): "
                + "; ".join(runner.unrendered.values())
            )
        if not ended:
            why = "the time limit is over" if runner.is_over() else "a training was stopped"
            raise TimeLimitError(
                f"{why}; {len(status(campaign).missing)} jobs are left. The same command goes on"
            )
    return status(campaign)


def _check_options(campaign: Campaign) -> None:
    """Raises ``InputError`` for options that records would not have as the file has them.

    Asked of the models' factories, so it loads them: not for a status.
    """
    for entry in campaign.entries:
        for model in entry.models if entry.options else ():
            from partialbench.benchmark.models import chosen_options

            chosen = chosen_options(model, entry.options)
            # As text: to Python 5 and 5.0 are equal, and a record has one of them.
            if json_text(chosen) != json_text(entry.options):
                raise InputError(
                    f"{campaign.path}: options of {model} are {dict(entry.options)}; of the types "
                    f"that it takes, and without those that are its defaults, they are {chosen}: "
                    f"write them so"
                )


class _Runner:
    """One run of a campaign: what is running, and where it is told to stop."""

    def __init__(
        self, campaign: Campaign, choice: Choice, device: str, deadline: float | None,
        say: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.campaign, self.choice, self.device = campaign, choice, device
        self.deadline, self.say = deadline, say
        self.stop = campaign.work / f"stop-{os.getpid()}"
        self.running: dict[Future, Job] = {}
        self.unrendered: dict[str, str] = {}
        self.killed: set[str] = set()
        self.told = 0.0  # when the file of what is running was last written

    def ledger(self) -> Ledger:
        """What is done now, of what can be; a grid that cannot be made holds up no training."""
        return Ledger(self.campaign, self.unrendered)

    def wanted(self, job: Job) -> bool:
        needed = {job.data, *(test.data for test in job.tests if not test.cell)}
        return needed.isdisjoint(self.unrendered) and self.choice.has(job)

    def render(self, workers: int, scheduler: str | None) -> None:
        """Makes the data sets that some missing job needs, one after the other.

        What is done by data that are only remembered may be of others than the file now asks for:
        where they can be made, they are, and tell.
        """
        ledger = self.ledger()
        state, data_sets = status(self.campaign, ledger), self.campaign.data
        told = {name for name in ledger.remembered if not data_sets[name].missing}
        needed = {name for job in filter(self.wanted, state.missing) for name in job.data_sets}
        needed |= {n for job in filter(self.wanted, state.done) for n in job.data_sets if n in told}
        for name in data_sets:
            if name in needed and not self.is_over():
                try:
                    left = None if self.deadline is None else self.deadline - time.monotonic()
                    _render(data_sets[name], workers, scheduler, self.say, left)
                except PartialbenchError as error:
                    # What can be trained without it is.
                    self.unrendered[name] = str(error)
                    self.say(str(error))

    def is_over(self) -> bool:
        return self.deadline is not None and time.monotonic() >= self.deadline

    def work(self, executor: Executor, width: int) -> bool:
        """Runs jobs until none is missing (True) or the time is over (False)."""
        stopped, state = False, declare(self.campaign, self.ledger())
        try:
            while True:
                if not self.is_over() and not stopped:
                    for job in self._next(state, width):
                        self._begin(executor, job)
                if not self.running:
                    return not stopped and not any(map(self.wanted, state.missing))
                done, _ = wait(self.running, timeout=2.0, return_when=FIRST_COMPLETED)
                if time.monotonic() - self.told > HEARTBEAT_S:
                    self._write_running()
                if self.is_over():
                    self.stop.touch()
                for future in done:
                    stopped |= self._end(future)
                if done:
                    state = declare(self.campaign, self.ledger())
                    self.say(f"{len(state.missing)} jobs, {state.hours:.1f} core hours to go")
        except BaseException:
            # Ctrl-C and whatever else: what runs saves its state first.
            self.stop.touch()
            self.say("stopping: each training saves its state")
            wait(self.running)
            raise

    def forget(self) -> None:
        """Removes what only a running campaign leaves about."""
        for path in (self.stop, self.campaign.work / RUNNING):
            path.unlink(missing_ok=True)

    def _next(self, state: Status, width: int) -> list[Job]:
        busy = {job.training for job in self.running.values()}
        chosen: list[Job] = []
        wanted = [job for job in state.missing if self.wanted(job)]
        for job in sorted(wanted, key=lambda job: (job.clouds, self.choice.rank(job) or 0)):
            if len(self.running) + len(chosen) >= width:
                break
            if job.training not in busy and job not in self.running.values():
                chosen.append(job)
                busy.add(job.training)
        return chosen

    def _begin(self, executor: Executor, job: Job) -> None:
        free = shutil.disk_usage(self.campaign.work).free
        if free < LEAST_FREE_BYTES:
            raise PartialbenchError(
                f"only {free / 1e6:.0f} MB are free where {self.campaign.work} is, fewer than "
                f"{LEAST_FREE_BYTES / 1e6:.0f}: a training could not save its state. Make room and "
                f"give the same command"
            )
        work = self.campaign.work
        # One that was tested before and has new tests is tested on those.
        tests = self.ledger().missing_tests(job) if job.kind == "train" else ()
        order = {
            "job": replace(job, tests=tests).as_dict(),
            "preset": self.campaign.preset, "device": self.device,
            "results": str(self.campaign.results), "runs": str(work / "runs"),
            "folders": {name: str(data.folder) for name, data in self.campaign.data.items()},
            "seconds": None if self.deadline is None else self.deadline - time.monotonic(),
            "log": str(work / "logs" / f"{file_name(job.title)}.log"),
        }  # fmt: skip
        self.running[executor.submit(run_in_process, order, str(self.stop))] = job
        self._write_running()
        self.say(f"begun: {job.title}")

    def _end(self, future: Future) -> bool:
        """Takes a finished job's word; True where it was stopped."""
        job = self.running.pop(future)
        self._write_running()
        answer = _answer(future, job)
        if answer["outcome"] == DONE:
            if not self.ledger().is_done(job):
                # Or it would be begun again for ever.
                raise PartialbenchError(
                    f"{job.title} says it is done, but {self.campaign.results} has no record of "
                    f"it; its data may have been rendered anew meanwhile, or its model's file "
                    f"edited"
                )
            self.say(f"done: {job.title}")
            return False
        if answer["outcome"] == STOPPED:
            self.say(f"saved: {job.title}")
            return True
        free = shutil.disk_usage(self.campaign.work).free
        if free < LEAST_FREE_BYTES:
            raise PartialbenchError(
                f"{job.title}: {answer['reason']} ({os.strerror(errno.ENOSPC)})"
            )
        diverged = answer.get("kind") == DIVERGED
        key = training_key(job) if diverged else failure_key(job)
        if answer.get("kind") == KILLED and key not in self.killed:
            # By a person, or for the memory of another program: no fault of the job's, once.
            self.killed.add(key)
            self.say(f"once more, from its saved state: {job.title}: {answer['reason']}")
            return False
        self.say(f"failed: {job.title}: {answer['reason']}")
        Failures(self.campaign).add(key, job.title, answer["reason"])
        return False

    def _write_running(self) -> None:
        content = {
            "pid": os.getpid(), "host": socket.gethostname(),
            "jobs": [job.as_dict() for job in self.running.values()],
        }  # fmt: skip
        write_atomically(self.campaign.work / RUNNING, json.dumps(content).encode())
        self.told = time.monotonic()


def _answer(future: Future, job: Job) -> dict[str, Any]:
    """What the job's process said, or what became of it.

    Raises:
        PartialbenchError: the cluster is gone, or no process can be started.
    """
    try:
        return future.result()
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # of Dask: every worker that took it died
            return {"outcome": FAILED, "reason": f"its workers died: {error}"}
        raise PartialbenchError(
            f"{job.title} has no answer: {type(error).__name__}: {error}. The same command goes on"
        ) from error


@contextlib.contextmanager
def _executor(
    scheduler: str | None, jobs: int | None, device: str
) -> Iterator[tuple[Executor, int]]:
    """Where jobs run, and how many side by side. Threads here only wait for their processes."""
    if scheduler is not None:
        with dask_cluster(scheduler) as cluster:
            yield cluster, jobs or cluster.workers
        return
    width = jobs or (1 if device.startswith("cuda") else os.cpu_count() or 1)
    with ThreadPoolExecutor(width, thread_name_prefix="campaign") as threads:
        yield threads, width


def _render(
    data: DataSet, workers: int, scheduler: str | None, say: Callable[[str], None],
    seconds: float | None = None,
) -> None:  # fmt: skip
    """Makes a data folder, or goes on with it, and holds it against its declared digests.

    Where the time is over before, what is done of it stays, and the next run goes on with it.
    """
    if is_rendered(data):
        digests(data)
        return
    say(f"rendering {data.name} into {data.folder}")
    where = ["--scheduler", scheduler] if scheduler else ["--workers", str(workers)]
    command = [
        sys.executable, "-P", "-m", "partialbench.cli", "render", *data.render,
        "--out", str(data.folder), *where,
    ]  # fmt: skip
    try:  # its bar and errors are the user's
        done = subprocess.run(command, stdout=subprocess.PIPE, timeout=seconds)
    except subprocess.TimeoutExpired:
        say(f"stopped: rendering {data.name}; what is done of it stays")
        return
    if done.returncode:
        raise PartialbenchError(
            f"the data set {data.name!r} could not be rendered (status {done.returncode}): "
            f"partialbench render {' '.join(data.render)} --out {data.folder}"
        )
    write_atomically(data.note, data.command.encode())
    digests(data)
