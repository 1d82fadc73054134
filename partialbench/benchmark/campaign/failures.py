"""Which jobs of a campaign failed, and why: the ``failures.jsonl`` beside its records."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

from partialbench.benchmark.campaign.file import Campaign
from partialbench.benchmark.campaign.jobs import Job
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

FAILURES = "failures.jsonl"


def failure_key(job: Job) -> str:
    """What a line of ``failures.jsonl`` names a job by."""
    return json.dumps([job.kind, *job.training, job.clouds])


def training_key(job: Job) -> str:
    """The same for a training that diverged: none of its milestones can be reached."""
    return json.dumps([job.kind, *job.training])


def keys_of(job: Job) -> tuple[str, str]:
    """By which a failure may be recorded that stops a job: its own and its training's."""
    return failure_key(job), training_key(job)


class Failures:
    """The ``failures.jsonl`` of a campaign's records: why jobs failed, by their keys.

    Campaigns that share a folder share the file; of the lines of another preset this one's jobs,
    which may be called the same, know nothing.
    """

    def __init__(self, campaign: Campaign) -> None:
        self.path, self.preset = campaign.results / FAILURES, campaign.preset

    def reasons(self) -> dict[str, str]:
        """Key → reason."""
        return {line["job"]: str(line["reason"]) for line in self._lines() if self._is_own(line)}

    def add(self, key: str, title: str, reason: str) -> None:
        """In the place of an earlier one of the same key."""
        line = {"job": key, "title": title, "reason": reason, "preset": self.preset}
        self._write([*self._without({key}), line])

    def forget(self, keys: Collection[str]) -> None:
        """So that their jobs are tried again."""
        self._write(self._without(keys))

    def _without(self, keys: Collection[str]) -> list[dict[str, Any]]:
        return [line for line in self._lines() if line["job"] not in keys or not self._is_own(line)]

    def _is_own(self, line: Mapping[str, Any]) -> bool:
        return line.get("preset", self.preset) == self.preset  # earlier ones do not say

    def _lines(self) -> list[dict[str, Any]]:
        if not self.path.is_file():
            return []
        try:
            lines = [
                json.loads(line) for line in self.path.read_text(encoding="utf-8").splitlines()
            ]
            if not all({"job", "reason"} <= line.keys() for line in lines):
                raise ValueError("a line lacks its job or its reason")
            return lines
        except (ValueError, AttributeError) as error:
            raise InputError(
                f"{self.path} is not a list of failures: {error}; delete it"
            ) from error

    def _write(self, lines: list[dict[str, Any]]) -> None:
        """Anew; no file for none."""
        if lines:
            text = "".join(json.dumps(line, sort_keys=True) + "\n" for line in lines)
            write_atomically(self.path, text.encode())
        else:
            self.path.unlink(missing_ok=True)
