"""Learning rate and batch-norm momentum over training, in the published recipe's own time.

A recipe says "×0.7 every 20 epochs" of its own 200. Under a protocol that trains for fewer epochs
the same curve is run through faster: at progress p in [0, 1] the value is the recipe's at its
epoch p·E. Samples are counted as on ModelNet40, 9,840 training objects an epoch, where recipes in
samples come from. The common recipe's "warm-up-stable-decay" has no time of its own: its milestone
says the steps (``milestones``). Options (``Recipe.schedule_options``):

- step: ``gamma`` with one of ``every_epochs``, ``every_samples``, ``milestones`` (epochs);
  ``floor``, the lowest rate.
- cosine: ``final_lr``.
- one-cycle: ``pct_start`` 0.3, ``div_factor`` 25, ``final_div_factor`` 1e4, ``torch``'s formula
  with cosine annealing; momentum is not cycled.
- plateau: ``factor``, ``patience`` (epochs without a new lowest training loss), ``floor``.
- warm-up-stable-decay: none. The rate rises in equal steps, stays, and in a branch falls in equal
  steps from what it had reached: a milestone within the warm-up has not seen the full rate.
- any of the others: ``bn_momentum``, torch's sense: {"start", "gamma", "floor"} with
  ``every_epochs`` or ``every_samples``, a staircase like step's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from partialbench.benchmark.protocol.milestones import Plan
from partialbench.errors import InputError
from partialbench.registry import Recipe, close_matches

if TYPE_CHECKING:  # what is planned, a campaign's status, needs no torch
    from torch import nn
    from torch.optim import Optimizer

PUBLISHED_EPOCH_SAMPLES = 9_840
"""Training objects of ModelNet40 as its point-cloud releases count them (9,840 of 9,843)."""

GROWN = "warm-up-stable-decay"
"""The schedule of a trunk and its branches; the only one whose length no epochs say."""

_OPTIONS: dict[str, set[str]] = {
    GROWN: set(),
    "constant": set(),
    "step": {"gamma", "every_epochs", "every_samples", "milestones", "floor"},
    "cosine": {"final_lr"},
    "one-cycle": {"pct_start", "div_factor", "final_div_factor"},
    "plateau": {"factor", "patience", "floor"},
}


_NEEDED = {"step": {"gamma"}, "plateau": {"factor", "patience"}}


def check(recipe: Recipe) -> None:
    """Raises ``InputError`` for a schedule there is not, or an option too many or too few."""
    if recipe.schedule not in _OPTIONS:
        raise InputError(
            f"no schedule named {recipe.schedule!r}{close_matches(recipe.schedule, _OPTIONS)}"
        )
    grown = recipe.schedule == GROWN
    if grown != (recipe.epochs is None):
        raise InputError(
            f"epochs={recipe.epochs} does not go with the schedule {recipe.schedule!r}: "
            + ("the milestone says how long it is, see --clouds" if grown else "give their number")
        )
    if recipe.average and not grown:
        raise InputError(
            f"average=True needs the schedule {GROWN!r}, over whose decay it is taken; the recipe "
            f"has {recipe.schedule!r}"
        )
    known = _OPTIONS[recipe.schedule] | (set() if grown else {"bn_momentum"})
    for option in recipe.schedule_options:
        if option not in known:
            raise InputError(
                f"schedule {recipe.schedule!r} has no option {option!r}"
                f"{close_matches(option, known)}"
            )
    missing = sorted(_NEEDED.get(recipe.schedule, set()) - set(recipe.schedule_options))
    if missing:
        raise InputError(
            f"schedule {recipe.schedule!r} needs {', '.join(missing)}; give "
            f'schedule_options={{"{missing[0]}":…}} with it'
        )
    if recipe.schedule == "step":
        staircase(0.0, recipe.schedule_options)


def staircase(epoch: float, options: Mapping[str, Any]) -> int:
    """How many steps a staircase has taken at the (fractional) published epoch."""
    # A hair is added so that a boundary hit exactly does not fall short by a rounding error.
    epoch = epoch + 1e-9
    if "milestones" in options:
        return sum(epoch >= m for m in options["milestones"])
    if "every_epochs" in options:
        return math.floor(epoch / options["every_epochs"])
    if "every_samples" in options:
        return math.floor(epoch * PUBLISHED_EPOCH_SAMPLES / options["every_samples"])
    raise InputError(
        f"a staircase needs every_epochs, every_samples or milestones, got {dict(options)}"
    )


def published_epochs(recipe: Recipe) -> int:
    """How many a published recipe has."""
    if recipe.epochs is None:
        raise InputError(f"the schedule {recipe.schedule!r} has no epochs")
    return recipe.epochs


def grown_rate(recipe: Recipe, plan: Plan, step: int) -> float:
    """The rate of the step with the number ``step``, from 0, in a trunk and its branch."""
    rate = recipe.lr
    if plan.warm_up:
        # In a branch the rise is over, also where it was not done.
        rate *= min(1.0, (min(step, plan.branch_at) + 1) / plan.warm_up)
    if step >= plan.branch_at:
        rate *= (plan.steps - step) / (plan.steps - plan.branch_at)
    return rate


def learning_rate(recipe: Recipe, progress: float) -> float:
    """A published schedule's rate at ``progress`` in [0, 1] of training; for "plateau" the rate
    before any cut."""
    options, epoch = recipe.schedule_options, progress * published_epochs(recipe)
    if recipe.schedule in ("constant", "plateau"):
        return recipe.lr
    if recipe.schedule == "step":
        rate = recipe.lr * options["gamma"] ** staircase(epoch, options)
        return max(rate, options.get("floor", 0.0))
    if recipe.schedule == "cosine":
        final = options.get("final_lr", 0.0)
        return final + (recipe.lr - final) * (1 + math.cos(math.pi * progress)) / 2
    # One cycle: from lr/div up to lr by pct_start, then down to lr/div/final_div.
    peak = options.get("pct_start", 0.3)
    low = recipe.lr / options.get("div_factor", 25.0)
    last = low / options.get("final_div_factor", 1e4)
    if progress < peak:
        start, end, part = low, recipe.lr, progress / peak
    else:
        start, end, part = recipe.lr, last, (progress - peak) / (1 - peak)
    return end + (start - end) * (1 + math.cos(math.pi * part)) / 2


def batch_norm_momentum(options: Mapping[str, Any], epoch: float) -> float:
    """Torch's momentum at the published epoch."""
    momentum = options["start"] * options["gamma"] ** staircase(epoch, options)
    return max(momentum, options.get("floor", 0.0))


class Schedule:
    """Sets rates before each step; holds the little state that "plateau" needs."""

    def __init__(self, recipe: Recipe, plan: Plan) -> None:
        check(recipe)
        self.recipe, self.plan = recipe, plan
        self.patience = 0
        if recipe.schedule == "plateau":
            published = recipe.schedule_options["patience"]
            self.patience = max(1, round(published * (plan.epochs or 1) / published_epochs(recipe)))
        self.factor, self.best, self.bad_epochs = 1.0, math.inf, 0

    def apply(self, optimizer: Optimizer, model: nn.Module, step: int) -> float:
        """Sets the rate (returned) and batch-norm momentum for a step."""
        progress = step / self.plan.steps
        if self.recipe.schedule == GROWN:
            rate = grown_rate(self.recipe, self.plan, step)
        else:
            rate = learning_rate(self.recipe, progress)
        if self.factor != 1.0:
            rate = max(rate * self.factor, self.recipe.schedule_options.get("floor", 0.0))
        for group in optimizer.param_groups:
            group["lr"] = rate
        decay = self.recipe.schedule_options.get("bn_momentum")
        if decay is not None:
            from torch.nn.modules.batchnorm import _BatchNorm

            momentum = batch_norm_momentum(decay, progress * published_epochs(self.recipe))
            for module in model.modules():
                if isinstance(module, _BatchNorm):
                    module.momentum = momentum
        return rate

    def end_epoch(self, train_loss: float) -> None:
        """Lets "plateau" see the epoch's mean training loss. Others ignore it."""
        if self.recipe.schedule != "plateau":
            return
        if train_loss < self.best * (1 - 1e-4):
            self.best, self.bad_epochs = train_loss, 0
        else:
            self.bad_epochs += 1
        if self.bad_epochs > self.patience:
            self.factor *= self.recipe.schedule_options["factor"]
            self.bad_epochs = 0

    def state_dict(self) -> dict[str, float]:
        return {"factor": self.factor, "best": self.best, "bad_epochs": self.bad_epochs}

    def load_state_dict(self, state: Mapping[str, float]) -> None:
        self.factor, self.best = state["factor"], state["best"]
        self.bad_epochs = int(state["bad_epochs"])
