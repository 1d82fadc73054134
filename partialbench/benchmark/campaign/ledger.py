"""What of a campaign is done, by the records, trials and failures in its folders."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

from partialbench import user_code
from partialbench.benchmark.campaign.data import digests
from partialbench.benchmark.campaign.failures import Failures, keys_of
from partialbench.benchmark.campaign.file import Campaign, card_of
from partialbench.benchmark.campaign.jobs import Condition, Job, json_text
from partialbench.benchmark.preflight import FULL_PRECISION
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.records import declared, results
from partialbench.benchmark.records.results import Result
from partialbench.benchmark.records.trials import FILE, Trial, read_trials
from partialbench.benchmark.variant import describe_changes, pairs_text
from partialbench.errors import InputError


class Ledger:
    """What a campaign's folders say about its jobs.

    Args:
        without: names of grids that cannot be rendered here: their cells are asked of no job.

    Attributes:
        digests: data set name → split (of a grid: cell) → digest.
        remembered: names of data sets that are not here, whose digests are those that the campaign
            wrote beside its records (``declare``) when they were.
        speeds: (model, options) → training clouds a second, medians as recorded.
        notes: sentences about records that do not count, and about what is remembered.
    """

    def __init__(self, campaign: Campaign, without: Collection[str] = ()) -> None:
        self.campaign, self.without = campaign, without
        self.digests = {name: digests(data) for name, data in campaign.data.items()}
        self.notes: list[str] = []
        self.remembered = self._remember()
        self.speeds: dict[tuple[str, str], float] = {}
        self._protocols: dict[str, Protocol] = {}
        self._recipes: dict[tuple[str, str, str], str] = {}
        self._done: set[tuple[object, ...]] = set()
        models = {model for entry in campaign.entries for model in entry.models}
        self._code = {model: user_code.digest_of_file(model) for model in models if ":" in model}
        for path in sorted(campaign.results.glob(f"*{results.SUFFIX}")):
            try:
                self._enter(results.read(path), path)
            except InputError as error:
                self.notes.append(str(error))
        self._tried = {_of_trial(trial) for trial in read_trials(campaign.results / FILE)}
        self._failed = Failures(campaign).reasons()

    def is_done(self, job: Job) -> bool:
        """Whether every test of the job has its record (a trial: its line)."""
        train = self.digests[job.data].get("train")
        if train is None:
            return False
        if job.kind == "tune":
            return self._trial(job, train) in self._tried
        return not self.missing_tests(job)

    def missing_tests(self, job: Job) -> tuple[Condition, ...]:
        """The tests of a training's job that have no record."""
        train = self.digests[job.data].get("train", "")
        return tuple(
            test
            for test in job.tests
            if self._record(job, train, test) not in self._done
            and not (test.cell and test.data in self.without)
        )

    def is_trained(self, job: Job) -> bool:
        """Whether a training reached its milestone: its own test has a record."""
        return job.kind == "train" and Condition(job.data) not in self.missing_tests(job)

    def has_failed(self, job: Job) -> bool:
        """Whether it, or an earlier milestone of its training, diverged or broke."""
        return any(key in self._failed for key in keys_of(job))

    def failure_of(self, job: Job) -> str:
        """Why it failed, as it was recorded; "" for one that has not."""
        return next((self._failed[key] for key in keys_of(job) if key in self._failed), "")

    def recipe_of(self, job: Job) -> str:
        """What a job's training depends on of its recipe, as JSON text."""
        key = (job.model, job.recipe, job.protocol)
        if key not in self._recipes:
            own = recipes.of_protocol(card_of(job.model), self.protocol_of(job))
            used = recipes.override(own, json.loads(job.recipe))
            self._recipes[key] = json_text(recipes.of_training(recipes.as_dict(used)))
        return self._recipes[key]

    def protocol_of(self, job: Job) -> Protocol:
        """What a job trains and is tested by."""
        if job.protocol not in self._protocols:
            self._protocols[job.protocol] = protocols.protocol(
                self.campaign.preset, **json.loads(job.protocol)
            )
        return self._protocols[job.protocol]

    def _remember(self) -> list[str]:
        """Fills in the digests of data that are not here, by what was written of them."""
        try:
            written = declared.read(declared_file(self.campaign))
        except InputError:  # none, or one that the next run writes anew
            return []
        known: dict[str, dict[str, str]] = {}
        for row in written:
            known.setdefault(row.train_data, {})["train"] = row.train_digest
            known.setdefault(row.test_data, {})["test"] = row.test_digest
        found = {
            name: {split: digest for split, digest in known.get(name, {}).items() if digest}
            for name, data in self.campaign.data.items()
            if not self.digests[name] and not data.cells
        }
        self.digests |= found
        names = [name for name, of_splits in found.items() if of_splits]
        if names:
            self.notes.append(
                f"not here are the data of {', '.join(names)}: what is done is told by the digests "
                f"that {declared_file(self.campaign).name} has of them"
            )
        return names

    def _enter(self, result: Result, path: Path) -> None:
        test = result.test_data
        if result.training.get("start") is not None:
            return  # fine-tuned: another row, and none that a campaign asks for
        code = self._code.get(result.model, "")
        if code and code != result.model_code:
            self.notes.append(
                f"{path} is of {result.model} before its file was edited (SHA-256 "
                f"{result.model_code[:12]} then, {code[:12]} now): it does not count"
            )
            return
        self._done.add(
            (
                result.model, json_text(result.options),
                json_text(recipes.of_training(result.recipe)),
                result.training["environment"].get("precision", FULL_PRECISION), result.seed,
                result.clouds,
                result.protocol_digest, result.train_data.digest, test.digest,
                test.points, result.given_pose, result.damage, result.grid,
            )
        )  # fmt: skip
        speed = result.training["clouds_per_second"]
        self.speeds.setdefault((result.model, json_text(result.options)), speed)

    def _record(self, job: Job, train: str, test: Condition) -> tuple[object, ...]:
        protocol = self.protocol_of(job)
        return (
            job.model, job.options, self.recipe_of(job), job.precision, job.seed, job.clouds,
            protocol.digest, train, self.digests[test.data].get(test.cell or "test"),
            test.points or protocol.num_points, test.pose, test.damage, test.cell,
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


def declared_file(campaign: Campaign) -> Path:
    """What ``declare`` writes: several campaigns may share a folder of records."""
    return campaign.results / f"{campaign.path.stem}{declared.SUFFIX}"
