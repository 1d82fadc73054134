"""Milestones: how many clouds a row has seen, and the steps that lead there.

A training is a trunk at a constant rate. A milestone of m clouds is a branch: it leaves the trunk
after four fifths of m, its rate falls to zero over the last fifth, and what it ends with is tested.
The trunk goes on from where the branch left it. So a row at m is what a training to m alone gives,
and a row with every milestone up to M costs 0.8·M + 0.2·Σm clouds.

Under published recipes there is no trunk: a schedule is one curve over its whole length, and a
milestone is the most clouds that a training may see.

Source: warm-up–stable–decay, Hu et al., MiniCPM, arXiv:2404.06395; a cooldown of a fifth,
Hägele et al., arXiv:2405.18392.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral

from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.errors import InputError
from partialbench.registry import Recipe

FIRST = 25_000
"""The regular milestones are this times a power of two: the trunk keeps what each would need."""
LOG_CLOUDS = 5_000
"""Clouds between the lines of a trunk's log."""
BRANCH_LINES = 5
"""Lines of a branch's log: the last is of the last fifth of its decay."""

_UNITS = {"": 1, "k": 1_000, "m": 1_000_000}
_GRAMMAR = re.compile(r"(\d+(?:\.\d+)?)([km]?)", re.IGNORECASE)


def parse(given: str | int) -> int:
    """``"25000"``, ``"100k"``, ``"1.6M"`` or a number as it is → a number of clouds.

    Raises:
        InputError: anything else, or a number that is not whole or not positive.
    """
    value: float = 0
    if isinstance(given, Integral) and not isinstance(given, bool):  # one of NumPy's too
        value = int(given)
    elif isinstance(given, str) and (match := _GRAMMAR.fullmatch(given.strip())):
        value = round(float(match[1]) * _UNITS[match[2].lower()], 6)
    if value < 1 or value != int(value):
        raise InputError(
            f"a number of clouds is a positive whole number such as 25000, 100k or 1M, got "
            f"{given!r}"
        )
    return int(value)


def parse_several(texts: Sequence[str]) -> tuple[int, ...]:
    """``["25k,50k", "100k"]`` → (25000, 50000, 100000): each text one number or several."""
    found = []
    for text in texts:
        try:
            found += [parse(part) for part in text.split(",")]
        except InputError as error:
            raise InputError(f"{error} in {text!r}; commas stand between several") from error
    return tuple(found)


def ordered(clouds: Sequence[str | int]) -> tuple[int, ...]:
    """Each milestone once, the nearest first.

    Raises:
        InputError: none, or one that is not a positive whole number.
    """
    if not clouds:
        raise InputError("clouds is empty: give at least one number of clouds to train to")
    return tuple(sorted({parse(value) for value in clouds}))


def name(clouds: int) -> str:
    """As ``parse`` reads it, short: "100k", "1M", "6016"."""
    for unit, letter in ((1_000_000, "M"), (1_000, "k")):
        if clouds % unit == 0:
            return f"{clouds // unit}{letter}"
    return str(clouds)


def branch_step(clouds: int, batch: int) -> int:
    """After how many steps the branch to a milestone leaves the trunk."""
    return 4 * clouds // 5 // batch


def regular(last_step: int, batch: int) -> dict[int, int]:
    """Steps at which a trunk of ``last_step`` steps keeps its state → the milestone it is for."""
    found, clouds = {}, FIRST
    while branch_step(clouds, batch) <= last_step:
        found[branch_step(clouds, batch)] = clouds
        clouds *= 2
    return found


@dataclass(frozen=True)
class Plan:
    """The steps of a training to one milestone.

    Attributes:
        clouds: the milestone, nominal. batch: clouds a step.
        steps: all of them. branch_at: how many of these are the trunk's; 0 where there is none.
        warm_up: steps over which the rate rises.
        epoch_steps: steps a pass over the training set.
        epochs: passes of a published schedule; None for a trunk and its branch.
    """

    clouds: int
    batch: int
    steps: int
    branch_at: int
    warm_up: int
    epoch_steps: int
    epochs: int | None = None

    @property
    def clouds_seen(self) -> int:
        """Exactly, repeats counted."""
        return self.steps * self.batch

    def ends_interval(self, done: int, in_branch: bool) -> bool:
        """Whether the log has a line after ``done`` steps."""
        if self.epochs is not None:
            return done % self.epoch_steps == 0
        if not in_branch:
            return done % max(1, LOG_CLOUDS // self.batch) == 0
        length = self.steps - self.branch_at
        ends = {self.branch_at + length * i // BRANCH_LINES for i in range(1, BRANCH_LINES + 1)}
        return done in ends


def plan(protocol: Protocol, recipe: Recipe, clouds: int, train_clouds: int) -> Plan:
    """The steps to a milestone on a training set of ``train_clouds`` clouds.

    Raises:
        InputError: the milestone is less than one batch.
    """
    batch = max(1, min(recipe.batch_size, train_clouds))
    epoch_steps = train_clouds // batch
    if recipe.epochs is not None:
        epochs = max(1, min(recipe.epochs, math.ceil(clouds / train_clouds)))
        return Plan(clouds, batch, epochs * epoch_steps, 0, 0, epoch_steps, epochs)
    if clouds < batch:
        raise InputError(f"{clouds} clouds are less than one batch of {batch}; ask for more")
    return Plan(
        clouds, batch, clouds // batch, branch_step(clouds, batch), protocol.warm_up // batch,
        epoch_steps,
    )  # fmt: skip


def describe(plan: Plan, recipe: Recipe, train_clouds: int) -> str:
    """How long a training is, in words.

    "100,000 clouds, 1.14 epochs of 87,400 clouds", and for a published schedule "20 epochs of
    87,400 clouds, where the recipe ends".
    """
    if plan.epochs is None:
        return (
            f"{plan.clouds_seen:,} clouds, {plan.clouds_seen / train_clouds:.3g} epochs of "
            f"{train_clouds:,} clouds"
        )
    text = f"{plan.epochs:,} epoch{'s' if plan.epochs > 1 else ''} of {train_clouds:,} clouds"
    asked = math.ceil(plan.clouds / train_clouds)
    if recipe.epochs == plan.epochs < asked:
        return f"{text}, where the recipe ends; {plan.clouds:,} clouds would be {asked:,}"
    return text
