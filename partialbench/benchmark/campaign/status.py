"""What of a campaign is done, running, waiting, failed and missing, and how long it will take."""

from __future__ import annotations

import json
import os
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from partialbench.benchmark.campaign.data import is_rendered
from partialbench.benchmark.campaign.file import Campaign
from partialbench.benchmark.campaign.jobs import Job, all_jobs
from partialbench.benchmark.campaign.ledger import Ledger
from partialbench.benchmark.protocol import milestones

RUNNING = "running.json"
HEARTBEAT_S, GONE_AFTER_S = 60.0, 600.0
"""How often a campaign writes ``RUNNING`` anew, and the age at which one of another machine, whose
processes cannot be asked for, is taken for what a killed one left behind."""
MOST_NOTES = 3


@dataclass
class Status:
    """Where a campaign stands.

    Attributes:
        done, running, missing, failed: jobs, in the campaign's order; what runs or failed is not
            among the missing. A training is done when every test of it is.
        trained: trainings that reached their milestone, whatever of their other tests is missing.
        waiting: jobs whose data cannot be made here → the reason.
        hours: of one core, for the trainings that are missing or running and have a recorded speed.
        without_speed: how many jobs have none.
        notes: sentences about records that do not count, and about data that are not here.
    """

    done: list[Job] = field(default_factory=list)
    running: list[Job] = field(default_factory=list)
    missing: list[Job] = field(default_factory=list)
    failed: list[Job] = field(default_factory=list)
    trained: list[Job] = field(default_factory=list)
    waiting: dict[Job, str] = field(default_factory=dict)
    hours: float = 0.0
    without_speed: int = 0
    notes: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON data."""
        return {
            "done": [job.title for job in self.done],
            "trained": [job.title for job in self.trained],
            "running": [job.title for job in self.running],
            "missing": [job.title for job in self.missing],
            "failed": [job.title for job in self.failed],
            "waiting": {job.title: why for job, why in self.waiting.items()},
            "core_hours_to_go": round(self.hours, 2),
            "jobs_without_a_recorded_speed": self.without_speed,
            "notes": self.notes,
        }

    def as_text(self) -> str:
        """A table of milestones by data set, and what is to be said besides."""
        everything = [*self.done, *self.running, *self.missing, *self.failed, *self.waiting]
        finished, trained = set(self.done), set(self.trained)
        lines = []
        for kind, heading in (("train", "trainings"), ("tune", "trials")):
            jobs = [job for job in everything if job.kind == kind]
            for data in sorted({job.data for job in jobs}):
                for clouds in sorted({job.clouds for job in jobs if job.data == data}):
                    here = [job for job in jobs if (job.data, job.clouds) == (data, clouds)]
                    done = sum(job in finished for job in here)
                    shares = f"{done:>4} of {len(here)} done"
                    if kind == "train":
                        reached = sum(job in trained for job in here)
                        shares = f"{reached:>4} of {len(here)} trained, {done} wholly tested"
                    name = milestones.name(clouds)
                    lines.append(f"{heading:10} {data:24} {name:>7}   {shares}")
        lines += [f"running    {job.title}" for job in self.running]
        lines += [f"failed     {job.title}" for job in self.failed]
        for reason in sorted(set(self.waiting.values())):
            count = sum(why == reason for why in self.waiting.values())
            lines.append(f"waiting    {count} jobs: {reason}")
        lines += [f"note       {note}" for note in self.notes[:MOST_NOTES]]
        if len(self.notes) > MOST_NOTES:
            lines.append(f"note       … and {len(self.notes) - MOST_NOTES} more records like these")
        tests_left = sum(job in trained for job in (*self.running, *self.missing))
        lines.append(
            f"to go      {self.hours:.1f} hours of one core"
            + (f", and {self.without_speed} jobs of unknown speed" if self.without_speed else "")
            + (f"; tests alone of {tests_left} trainings, not counted" if tests_left else "")
        )
        return "\n".join(lines)


def status(campaign: Campaign, ledger: Ledger | None = None) -> Status:
    """Reads the campaign's folders; trains and renders nothing and loads no torch."""
    ledger = ledger or Ledger(campaign)
    running = read_running(campaign.work / RUNNING)
    found = Status(notes=list(ledger.notes))
    reached: dict[tuple[object, ...], int] = {}
    for job in all_jobs(campaign):
        if is_trained := ledger.is_trained(job):
            found.trained.append(job)
        if ledger.is_done(job):
            found.done.append(job)
            reached[job.training] = max(reached.get(job.training, 0), job.clouds)
            continue
        if job in running:
            found.running.append(job)
        elif ledger.has_failed(job):
            found.failed.append(job)
            continue
        elif reason := _cannot_be_made(campaign, job):
            found.waiting[job] = reason
            continue
        else:
            found.missing.append(job)
        if is_trained:  # only tests are missing
            reached[job.training] = max(reached.get(job.training, 0), job.clouds)
            continue
        speed = ledger.speeds.get((job.model, job.options))
        if speed is None:
            found.without_speed += 1
            continue
        # The trunk goes on from where its last milestone branched; each branch is a fifth.
        before = reached.get(job.training, 0)
        found.hours += (0.8 * (job.clouds - before) + 0.2 * job.clouds) / speed / 3600
        reached[job.training] = job.clouds
    return found


def _cannot_be_made(campaign: Campaign, job: Job) -> str:
    for name in job.data_sets:
        data = campaign.data[name]
        if data.missing and not is_rendered(data):
            return f"data set {name!r} needs the environment variable {', '.join(data.missing)}"
    return ""


def read_running(path: Path) -> set[Job]:
    """The jobs that a campaign at work in this folder says it is at; none of one that is gone."""
    from partialbench.benchmark.campaign.jobs import from_dict

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["host"] == socket.gethostname():
            is_gone = not _alive(content["pid"])
        else:
            is_gone = time.time() - path.stat().st_mtime > GONE_AFTER_S
        if is_gone:
            return set()
        return {from_dict(fields) for fields in content["jobs"]}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
