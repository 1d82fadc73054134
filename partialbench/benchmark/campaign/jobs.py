"""From a campaign file to jobs: which exist, and in which order.

A job is one training (model, options, recipe, data, seed) taken to one milestone and tested there,
or one trial. Jobs of one training are done in the order of their milestones, by one process at a
time.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from partialbench.benchmark.campaign.file import Campaign, Entry, card_of
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.variant import describe_changes, pairs_text, with_changes


@dataclass(frozen=True)
class Condition:
    """On what a milestone is tested: the data set's name, points of a cloud (None: as trained), the
    pose that is given, the damage done and, of a grid, the cell ("" for none)."""

    data: str
    points: int | None = None
    pose: str = ""
    damage: str = ""
    cell: str = ""


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
    def data_sets(self) -> tuple[str, ...]:
        """Names of those it is trained and tested on."""
        return tuple(dict.fromkeys((self.data, *(test.data for test in self.tests))))

    @property
    def title(self) -> str:
        """For people: "papnet [grid=16] on clouds, seed 0, 50k"."""
        changes = describe_changes(
            json.loads(self.recipe), json.loads(self.options), None, self.precision
        )
        row = with_changes(self.model, changes)
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
        for job in _jobs_of(entry, campaign):
            key = (job.kind, *job.training, job.clouds)
            tests = dict.fromkeys((*(found[key].tests if key in found else ()), *job.tests))
            found[key] = Job(**{**vars(job), "tests": tuple(tests)})
    return sorted(found.values(), key=lambda job: (job.clouds, job.seed))


def _jobs_of(entry: Entry, campaign: Campaign) -> Iterable[Job]:
    tries = entry.tries or ({},)
    cells = [
        Condition(name, cell=cell) for name in entry.grids for cell in campaign.data[name].cells
    ]
    changed = {model: _recipe_of(entry, model, campaign.preset) for model in entry.models}
    for clouds in entry.clouds:
        for seed in entry.seeds:
            for model in entry.models:
                for data in entry.data:
                    tests = _tests(entry, data, cells) if entry.kind == "train" else ()
                    for changes in tries:
                        recipe = {**changed[model], **changes}
                        yield Job(
                            entry.kind, model, json_text(entry.options), json_text(recipe),
                            entry.precision, data, seed, clouds, tests, json_text(entry.protocol),
                        )  # fmt: skip


def _recipe_of(entry: Entry, model: str, preset: str) -> Mapping[str, Any]:
    """What an entry changes about a model's recipe.

    What the model has anyway is no change of a training, nor of its row: two jobs of one training
    would be in each other's way. Of a trial it is: a trial is told by all that it was given.
    """
    if entry.kind == "tune" or not entry.recipe:
        return entry.recipe
    protocol = protocols.protocol(preset, **entry.protocol)
    return recipes.changes(recipes.of_protocol(card_of(model), protocol), entry.recipe)


def _tests(entry: Entry, data: str, cells: Iterable[Condition]) -> tuple[Condition, ...]:
    own = [Condition(name) for name in dict.fromkeys((data, *entry.test))]
    return (
        *own,
        *(Condition(test.data, points) for test in own for points in entry.points),
        *(Condition(test.data, None, pose) for test in own for pose in entry.poses),
        *(Condition(test.data, None, "", name) for test in own for name in entry.damages),
        *cells,
    )


def json_text(data: Mapping[str, Any]) -> str:
    """Of options and recipes: equal ones have one text."""
    return json.dumps(data, sort_keys=True)
