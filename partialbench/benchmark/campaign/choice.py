"""Which jobs of a campaign one run of it does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from partialbench import registry
from partialbench.benchmark.campaign.file import Campaign
from partialbench.benchmark.campaign.jobs import Job, all_jobs
from partialbench.benchmark.protocol import milestones
from partialbench.errors import InputError


def choose(only: Sequence[str] = (), up_to: str | int | None = None, trials: bool = True) -> Choice:
    """By the arguments of ``run.run`` that are so called."""
    return Choice(only, None if up_to is None else milestones.parse(up_to), trials)


@dataclass(frozen=True)
class Choice:
    """Which jobs a run of a campaign does: see ``run.run``."""

    only: Sequence[str]
    last: int | None
    trials: bool

    def rank(self, job: Job) -> int | None:
        """The number of the first pattern that a job fits, 0 where there are none, or None."""
        fits = (i for i, pattern in enumerate(self.only or ["*"]) if _fits(job, pattern))
        return next(fits, None)

    def has(self, job: Job) -> bool:
        """Whether the job is done by this run."""
        too_long = self.last is not None and job.clouds > self.last
        left_out = job.kind == "tune" and not self.trials
        return not too_long and not left_out and self.rank(job) is not None

    def require_some(self, campaign: Campaign) -> None:
        """Raises ``InputError`` where a pattern, or all together, name nothing of a campaign."""
        jobs = all_jobs(campaign)
        data_sets = {job.data for job in jobs}
        for pattern in self.only:
            if not any(_fits(job, pattern) for job in jobs):
                model, _, data = pattern.partition("@")
                known = any(fnmatchcase(name, data or "*") for name in data_sets)
                wrong, names = (model, {job.model for job in jobs}) if known else (data, data_sets)
                near = registry.close_matches(wrong, names)
                raise InputError(f"--only {pattern!r} fits no run of {campaign.path}{near}")
        if not any(map(self.has, jobs)):
            first = min(job.clouds for job in jobs if self.rank(job) is not None)
            why = (
                f"--up-to is {milestones.name(self.last)}, its first milestone "
                f"{milestones.name(first)}" if self.last is not None and self.last < first
                else "without trials nothing is left of it"
            )  # fmt: skip
            raise InputError(f"no run of {campaign.path} is asked for: {why}")


def _fits(job: Job, pattern: str) -> bool:
    return fnmatchcase(f"{job.model}@{job.data}", pattern if "@" in pattern else f"{pattern}@*")
