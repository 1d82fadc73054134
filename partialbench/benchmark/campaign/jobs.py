"""From a campaign file to jobs: which exist, which are done, which failed, which is next.

A job is one training (model, options, recipe, data, seed) taken to one milestone and tested there,
or one trial. Jobs of one training are done in the order of their milestones, by one process at a
time.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from partialbench.benchmark.campaign.file import Campaign, DataSet, Entry, card_of
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.records import results
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.records.trials import FILE, Trial, read_trials
from partialbench.benchmark.variant import describe_changes, pairs_text
from partialbench.dataset import manifest as manifests
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

log = logging.getLogger(__name__)

FAILURES = "failures.jsonl"


@dataclass(frozen=True)
class Condition:
    """On what a milestone is tested: the data set's name, points of a cloud (None: as trained), the
    pose that is given and the damage done ("" for none)."""

    data: str
    points: int | None = None
    pose: str = ""
    damage: str = ""


@dataclass(frozen=True)
class Job:
    """One training taken to one milestone, or one trial.

    Attributes:
        kind: "train" or "tune".
        options, recipe: as JSON text, so that a job can be hashed and sent; a trial's own changes
            are in ``recipe``.
        data: name of the data set. clouds: the milestone.
        tests: what is tested there; () for a trial.
        protocol: fields of the campaign's preset that are changed, as JSON text.
    """

    kind: str
    model: str
    options: str
    recipe: str
    precision: str
    data: str
    seed: int
    clouds: int
    tests: tuple[Condition, ...] = ()
    protocol: str = "{}"

    @property
    def training(self) -> tuple[object, ...]:
        """What is one trunk: no two of its jobs run at once."""
        # By the preset as it is, it is named as before entries could change it: failures are
        # remembered by this.
        changed = () if self.protocol == "{}" else (self.protocol,)
        return (
            self.model, self.options, self.recipe, self.precision, self.data, self.seed, *changed,
        )  # fmt: skip

    @property
    def title(self) -> str:
        """For people: "papnet [grid=16] on clouds, seed 0, 50k"."""
        changes = describe_changes(
            json.loads(self.recipe), json.loads(self.options), None, self.precision
        )
        row = results.with_changes(self.model, changes)
        protocol = pairs_text(json.loads(self.protocol))
        by = f", {protocol}" if protocol else ""
        trial = " (trial)" if self.kind == "tune" else ""
        return f"{row} on {self.data}{by}, seed {self.seed}, {milestones.name(self.clouds)}{trial}"

    def as_dict(self) -> dict[str, Any]:
        """Plain JSON data."""
        return asdict(self)


def from_dict(fields: Mapping[str, Any]) -> Job:
    """The job that ``as_dict`` described."""
    tests = tuple(Condition(**test) for test in fields["tests"])
    return Job(**{**fields, "tests": tests})


def all_jobs(campaign: Campaign) -> list[Job]:
    """Every job of a campaign, the lowest milestone first, then by seed, then as the file has them.

    So the row that is behind is the next to grow, and a first seed of every model comes before a
    second of any.
    """
    found: dict[tuple[object, ...], Job] = {}
    for entry in campaign.entries:
        for job in _jobs_of(entry):
            key = (job.kind, *job.training, job.clouds)
            tests = dict.fromkeys((*(found[key].tests if key in found else ()), *job.tests))
            found[key] = Job(**{**vars(job), "tests": tuple(tests)})
    return sorted(found.values(), key=lambda job: (job.clouds, job.seed))


def _jobs_of(entry: Entry) -> Iterable[Job]:
    tries = entry.tries or ({},)
    for clouds in entry.clouds:
        for seed in entry.seeds:
            for model in entry.models:
                for data in entry.data:
                    tests = _tests(entry, data) if entry.kind == "train" else ()
                    for changes in tries:
                        yield Job(
                            entry.kind, model, _json(entry.options),
                            _json({**entry.recipe, **changes}), entry.precision, data, seed, clouds,
                            tests, _json(entry.protocol),
                        )  # fmt: skip


def _tests(entry: Entry, data: str) -> tuple[Condition, ...]:
    own = [Condition(name) for name in dict.fromkeys((data, *entry.test))]
    return (
        *own,
        *(Condition(test.data, points) for test in own for points in entry.points),
        *(Condition(test.data, None, pose) for test in own for pose in entry.poses),
        *(Condition(test.data, None, "", name) for test in own for name in entry.damages),
    )


def _json(data: Mapping[str, Any]) -> str:
    return json.dumps(data, sort_keys=True)


def digests(data: DataSet) -> dict[str, str]:
    """Split → digest of a data set: of its folder where that is complete, else as declared.

    Raises:
        InputError: a complete folder whose digests are not the declared ones.
    """
    if not (data.folder / manifests.NAME).is_file():
        return dict(data.digests)
    manifest = manifests.load(data.folder)
    if manifest.state != "complete":
        return dict(data.digests)
    for split, declared in data.digests.items():
        found = manifest.digests.get(split, "(no such split)")
        if found != declared:
            made = ", ".join(f"{name} {version}" for name, version in manifest.versions.items())
            raise InputError(
                f"the {split} split of data set {data.name!r} in {data.folder} has the digest "
                f"{found}, made by {made}; the campaign declares {declared}"
                + (f", made by {data.made_by}" if data.made_by else "")
                + ". Delete the folder to have it rendered again by this version, or correct the "
                "campaign file if the data are meant to have changed"
            )
    return dict(manifest.digests)


class Ledger:
    """What a campaign's folders say about its jobs.

    Attributes:
        digests: data set name → split → digest.
        speeds: (model, options) → training clouds a second, medians as recorded.
        unreadable: sentences about records that could not be read.
    """

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.digests = {name: digests(data) for name, data in campaign.data.items()}
        self.unreadable: list[str] = []
        self.speeds: dict[tuple[str, str], float] = {}
        self._protocols: dict[str, Protocol] = {}
        self._recipes: dict[tuple[str, str, str], str] = {}
        self._done: set[tuple[object, ...]] = set()
        for path in sorted(campaign.results.glob(f"*{results.SUFFIX}")):
            try:
                self._enter(results.read(path))
            except InputError as error:
                self.unreadable.append(str(error))
        self._tried = {_of_trial(trial) for trial in read_trials(campaign.results / FILE)}
        self.failures = read_failures(campaign.results / FAILURES)
        self._failed = {failure["job"]: str(failure["reason"]) for failure in self.failures}

    def is_done(self, job: Job) -> bool:
        """Whether every test of the job has its record (a trial: its line)."""
        train = self.digests[job.data].get("train")
        if train is None:
            return False
        if job.kind == "tune":
            return self._trial(job, train) in self._tried
        return all(self._record(job, train, test) in self._done for test in job.tests)

    def has_failed(self, job: Job) -> bool:
        """Whether it, or an earlier milestone of its training, diverged or broke."""
        return any(key in self._failed for key in (failure_key(job), training_key(job)))

    def failure_of(self, job: Job) -> str:
        """Why it failed, as it was recorded; "" for one that has not."""
        keys = (failure_key(job), training_key(job))
        return next((self._failed[key] for key in keys if key in self._failed), "")

    def recipe_of(self, job: Job) -> str:
        """The whole recipe that a job trains by, as JSON text."""
        key = (job.model, job.recipe, job.protocol)
        if key not in self._recipes:
            own = recipes.of_protocol(card_of(job.model), self.protocol_of(job))
            used = recipes.override(own, json.loads(job.recipe))
            self._recipes[key] = _json(recipes.as_dict(used))
        return self._recipes[key]

    def protocol_of(self, job: Job) -> Protocol:
        """What a job trains and is tested by."""
        if job.protocol not in self._protocols:
            self._protocols[job.protocol] = protocols.protocol(
                self.campaign.preset, **json.loads(job.protocol)
            )
        return self._protocols[job.protocol]

    def _enter(self, result: Result) -> None:
        test = result.test_data
        self._done.add(
            (
                result.model, _json(result.options), _json(result.recipe),
                result.training["environment"]["precision"], result.seed, result.clouds,
                result.protocol_digest, result.train_data.digest, test.digest,
                test.points, result.given_pose, result.damage,
            )
        )  # fmt: skip
        speed = result.training["clouds_per_second"]
        self.speeds.setdefault((result.model, _json(result.options)), speed)

    def _record(self, job: Job, train: str, test: Condition) -> tuple[object, ...]:
        protocol = self.protocol_of(job)
        return (
            job.model, job.options, self.recipe_of(job), job.precision, job.seed, job.clouds,
            protocol.digest, train, self.digests[test.data].get("test"),
            test.points or protocol.num_points, test.pose, test.damage,
        )  # fmt: skip

    def _trial(self, job: Job, train: str) -> tuple[object, ...]:
        changes = json.loads(job.recipe)
        batch = json.loads(self.recipe_of(job))["batch_size"]
        return (
            job.model, describe_changes({}, json.loads(job.options), None, job.precision),
            pairs_text(changes), job.seed, train, self.protocol_of(job).digest,
            job.clouds // batch * batch,
        )  # fmt: skip


def _of_trial(trial: Trial) -> tuple[object, ...]:
    return (
        trial.model, trial.options, trial.recipe, trial.seed, trial.data, trial.protocol,
        trial.clouds_seen,
    )  # fmt: skip


def failure_key(job: Job) -> str:
    """What a line of ``failures.jsonl`` names a job by."""
    return json.dumps([job.kind, *job.training, job.clouds])


def training_key(job: Job) -> str:
    """The same for a training that diverged: none of its milestones can be reached."""
    return json.dumps([job.kind, *job.training])


def read_failures(path: Path) -> list[dict[str, Any]]:
    """The lines of a ``failures.jsonl``; none where there is no such file."""
    if not path.is_file():
        return []
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path} is not a list of failures: {error}; delete it") from error


def write_failures(path: Path, failures: list[dict[str, Any]]) -> None:
    """Writes the list anew; no file for an empty one."""
    if failures:
        lines = "".join(json.dumps(each, sort_keys=True) + "\n" for each in failures)
        write_atomically(path, lines.encode())
    else:
        path.unlink(missing_ok=True)
