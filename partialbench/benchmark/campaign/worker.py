"""One job in a process of its own, with JSON on stdin; its last line on stdout says how it ended.

A process of its own, so that a crash or a want of memory ends one job and not the campaign, and so
that a Dask worker runs it the same way. It leaves when its parent is gone: a campaign that was
killed has no trainings left behind that the next one would meet.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from partialbench.benchmark.campaign.jobs import Job, from_dict
from partialbench.errors import PartialbenchError, TimeLimitError

DONE, FAILED, STOPPED = "done", "failed", "stopped"
# -P: a user's random.py in the current folder is not everyone's.
_COMMAND = ["-P", "-m", __name__]
DIVERGED, KILLED = "diverged", "killed"
"""Kinds of failure that are told apart from others."""


def run_in_process(order: dict[str, Any], stop: str) -> dict[str, Any]:
    """Runs one job in a new process and waits for it; what ``main`` printed.

    Args:
        order: what ``main`` takes. ``log``: where its stderr goes, added to.
        stop: a path; when a file appears there, the job is asked to save and leave. Files are what
            a campaign shares with workers on other machines.
    """
    environment = {"OMP_NUM_THREADS": "1", **os.environ}
    log = Path(order["log"])
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab") as stderr:
        process = subprocess.Popen(
            [sys.executable, *_COMMAND],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, env=environment,
            start_new_session=True,  # Ctrl-C reaches the campaign, which asks by the file
        )  # fmt: skip
        answer, _ = process.communicate(json.dumps({**order, "stop": stop}).encode())
    lines = answer.decode(errors="replace").splitlines()
    try:
        return json.loads(lines[-1])
    except (IndexError, json.JSONDecodeError):
        status = process.returncode
        how = f"was killed by {_signal_name(-status)}" if status < 0 else f"ended with {status}"
        return {
            "outcome": FAILED,
            "reason": f"its process {how} without a word, perhaps for want of memory; {log} has "
            f"what it said",
            **({"kind": KILLED} if status < 0 else {}),
        }


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def main() -> None:
    """Reads an order, does the job, says how it ended."""
    order = json.load(sys.stdin)
    stop, parent = Path(order["stop"]), os.getppid()

    def watch() -> None:
        while True:
            if os.getppid() != parent:
                os._exit(1)
            time.sleep(1.0)

    threading.Thread(target=watch, daemon=True).start()
    outcome = outcome_of(from_dict(order["job"]), order, stop)
    sys.stdout.write(f"\n{json.dumps(outcome)}\n")


def outcome_of(job: Job, order: dict[str, Any], stop: Path) -> dict[str, Any]:
    """Does the job and says how it ended."""
    # Imported here: in a process of its own the watch is on before torch takes its seconds.
    from partialbench.benchmark.training.loop import DivergedError

    try:
        _work(job, order, stop)
    except TimeLimitError as error:
        return {"outcome": STOPPED, "reason": str(error)}
    except DivergedError as error:
        return {"outcome": FAILED, "reason": str(error), "kind": DIVERGED}
    except PartialbenchError as error:
        return {"outcome": FAILED, "reason": str(error)}
    return {"outcome": DONE}


def _work(job: Job, order: dict[str, Any], stop: Path) -> None:
    deadline = None if order["seconds"] is None else time.monotonic() + order["seconds"]
    common: dict[str, Any] = {
        "preset": order["preset"], "device": order["device"],
        "results_folder": order["results"], "runs_folder": order["runs"],
        "precision": job.precision, "options": json.loads(job.options),
        "protocol": json.loads(job.protocol),
        "should_stop": lambda: stop.exists() or (
            deadline is not None and time.monotonic() > deadline
        ),
    }  # fmt: skip
    folders = order["folders"]
    if job.kind == "tune":
        from partialbench.benchmark.tune import tune

        tune(
            job.model, folders[job.data], [json.loads(job.recipe)], seed=job.seed,
            clouds=job.clouds, **common,
        )  # fmt: skip
        return
    from partialbench.benchmark.run import run_eval

    asked: dict[str, dict[Path, list[Any]]] = {"points": {}, "pose": {}, "damage": {}}
    for test in job.tests:
        for kind, of_folder in asked.items():
            if condition := getattr(test, kind):
                of_folder.setdefault(Path(folders[test.data]), []).append(condition)
    run_eval(
        job.model, folders[job.data],
        [folders[t.data] for t in job.tests if t.data != job.data and not t.cell],
        seeds=1, first_seed=job.seed, clouds=[job.clouds], recipe=json.loads(job.recipe),
        test_points=asked["points"], test_poses=asked["pose"], test_damages=asked["damage"],
        test_grid=[Path(folders[t.data]) / t.cell for t in job.tests if t.cell], **common,
    )  # fmt: skip


if __name__ == "__main__":
    main()
