"""The folder of a training: its trunk's states, its branches, and how far it is. Needs no torch.

    runs/pointnet_pm40-1a2b3c4d_board-5e6f7a8b_seed0/
        progress.json
        trunk/clouds-80000.pt
        branch-100k/checkpoint.pt, log.csv

A trunk's state is kept where a regular milestone that is not done would branch from it, and the
last one. Any other, and any that is lost, is made again from the state before, or from the seed,
with the same bytes.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from partialbench.benchmark.protocol import milestones
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError

PROGRESS_FILE = "progress.json"
_STATE = re.compile(r"clouds-(\d+)\.pt")


@dataclass(frozen=True)
class Progress:
    """How far a training is, by what is saved of it.

    Attributes:
        clouds_seen: by the trunk's last state.
        milestones_done: whose branches are finished, ascending.
        clouds_per_second: of training steps, median over the log; None before its first line.
        branches: of an unfinished branch, milestone → clouds seen, the trunk's among them.
    """

    clouds_seen: int = 0
    milestones_done: tuple[int, ...] = ()
    clouds_per_second: float | None = None
    branches: dict[int, int] = field(default_factory=dict)


def progress(folder: Path | str) -> Progress:
    """How far the training in a folder is; nowhere where nothing was saved.

    Raises:
        InputError: the folder's ``progress.json`` is damaged.
    """
    path = Path(folder) / PROGRESS_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return Progress(
            int(content["clouds_seen"]),
            tuple(map(int, content["milestones_done"])),
            content["clouds_per_second"],
            {int(m): int(seen) for m, seen in content["branches"].items()},
        )
    except FileNotFoundError:
        return Progress()
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} does not say how far a training is ({error!r}); delete it, the next "
            f"evaluation writes it anew"
        ) from error


class RunFolder:
    """The files of one training."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def branch(self, clouds: int) -> Path:
        """The checkpoint of a milestone."""
        return self.folder / f"branch-{milestones.name(clouds)}" / "checkpoint.pt"

    def state(self, clouds_seen: int) -> Path:
        """The state of the trunk after so many clouds."""
        return self.folder / "trunk" / f"clouds-{clouds_seen}.pt"

    def states(self) -> dict[int, Path]:
        """Clouds seen → the trunk's state that is there, ascending."""
        found = {}
        for path in (self.folder / "trunk").glob("clouds-*.pt"):
            if match := _STATE.fullmatch(path.name):
                found[int(match[1])] = path
        return dict(sorted(found.items()))

    def nearest(self, clouds_seen: int) -> Path | None:
        """The last state of the trunk at or before so many clouds."""
        before = [path for seen, path in self.states().items() if seen <= clouds_seen]
        return before[-1] if before else None

    def prune(self, clouds_seen: int, wanted: Iterable[int], batch: int) -> None:
        """Deletes the states before ``clouds_seen`` that no milestone to come branches from.

        Args:
            wanted: milestones that are asked for, whatever their number.
            batch: clouds a step.
        """
        done = progress(self.folder).milestones_done
        asked = {milestones.branch_step(m, batch): m for m in wanted}
        asked |= milestones.regular(clouds_seen // batch, batch)
        kept = {step * batch for step, milestone in asked.items() if milestone not in done}
        for seen, path in self.states().items():
            if seen < clouds_seen and seen not in kept:
                path.unlink(missing_ok=True)

    def note(
        self,
        clouds_per_second: float | None,
        branch: tuple[int, int] | None = None,
        done: int | None = None,
    ) -> None:
        """Writes ``progress.json`` anew.

        Args:
            branch: the milestone of an unfinished branch and the clouds it has seen.
            done: a milestone whose branch is finished.
        """  # fmt: skip
        try:
            before = progress(self.folder)
        except InputError:
            before = Progress()
        states = self.states()
        branches = dict(before.branches)
        if branch is not None:
            branches[branch[0]] = branch[1]
        finished = set(before.milestones_done) | ({done} if done is not None else set())
        # A branch that was deleted is not done.
        finished = {milestone for milestone in finished if self.branch(milestone).is_file()}
        now = Progress(
            max(states, default=0),
            tuple(sorted(finished)),
            before.clouds_per_second if clouds_per_second is None else clouds_per_second,
            {
                milestone: seen
                for milestone, seen in sorted(branches.items())
                if milestone not in finished and self.branch(milestone).is_file()
            },
        )
        text = json.dumps(dataclasses.asdict(now), indent=1) + "\n"
        write_atomically(self.folder / PROGRESS_FILE, text.encode())
