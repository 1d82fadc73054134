"""Writes, beside the records, what a campaign asks for and how far each row of it is."""

from __future__ import annotations

import json
from collections.abc import Iterator

from partialbench.benchmark.campaign.file import Campaign, card_of
from partialbench.benchmark.campaign.jobs import Condition, Job
from partialbench.benchmark.campaign.ledger import Ledger, declared_file
from partialbench.benchmark.campaign.status import Status, status
from partialbench.benchmark.records import declared
from partialbench.benchmark.records.declared import Declared, State
from partialbench.benchmark.variant import describe_changes, pairs_text


def declare(campaign: Campaign, ledger: Ledger | None = None) -> Status:
    """Writes the file (see ``records.declared``) and says where the campaign stands."""
    ledger = ledger or Ledger(campaign)
    found = status(campaign, ledger)
    campaign.results.mkdir(parents=True, exist_ok=True)
    declared.write(declared_file(campaign), _rows(campaign, ledger, found))
    return found


def _rows(campaign: Campaign, ledger: Ledger, found: Status) -> Iterator[Declared]:
    """Every test of the campaign that makes a row; tests under other conditions make none."""
    of_state: dict[State, dict[Job, str]] = {
        "done": dict.fromkeys(found.done, ""),
        # What runs is not there yet; that it runs is true for minutes, and the file is kept.
        "missing": dict.fromkeys([*found.running, *found.missing], ""),
        "failed": {job: ledger.failure_of(job) for job in found.failed},
        "waiting": found.waiting,
    }
    for state, jobs in of_state.items():
        for job, reason in jobs.items():
            changes = describe_changes(
                json.loads(job.recipe), json.loads(job.options), None, job.precision
            )
            protocol = ledger.protocol_of(job)
            changed = pairs_text(json.loads(job.protocol))
            for test in job.tests:
                if test == Condition(test.data):
                    yield Declared(
                        train_data=job.data,
                        test_data=test.data,
                        train_digest=ledger.digests[job.data].get("train", ""),
                        test_digest=ledger.digests[test.data].get("test", ""),
                        protocol=" ".join(filter(None, [campaign.preset, changed])),
                        protocol_digest=protocol.digest,
                        clouds=job.clouds,
                        model=job.model,
                        variant=changes,
                        title=card_of(job.model).title,
                        seed=job.seed,
                        state=state,
                        reason=reason,
                    )
