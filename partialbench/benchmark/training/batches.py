"""The stream of training batches: a function of (seed, epoch, batch), so that it can be resumed.

Nothing here remembers what came before: the order of an epoch is keyed by (seed, epoch), the
augmentation of a batch by (seed, epoch, batch). With several processes each takes its share of the
same batch, so their number changes neither order nor augmentation.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from partialbench.benchmark import inputs
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.prediction import Batch
from partialbench.benchmark.protocol.protocol import Protocol
from partialbench.benchmark.training.stretch import stretched
from partialbench.dataset.seeding import generator
from partialbench.dataset.settings import turns_of
from partialbench.errors import InputError
from partialbench.geometry.rotations import axis_rotation, haar_rotations
from partialbench.geometry.symmetry import map_rotations


class Place(NamedTuple):
    """Where in training a batch belongs: epoch and number within it, both from 0."""

    epoch: int
    batch: int


class BatchStream:
    """Augmented training batches of some rows of a data set.

    Each cloud p of a batch becomes Q·S·p + jitter with a rotation Q of its own (any, or as the
    data's setting has it: about z alone, or none) and, where the protocol asks for it, a stretching
    S along its object's axes; its label R becomes Q·R. A last
    incomplete batch is left out (one cloud alone would break batch norm); an epoch's order is new
    each time, so no cloud is left out for good.

    Args:
        rows: (m,) row numbers to train on.
        batch_size: clouds a step over all processes; all rows at once when there are fewer.
        normals: whether batches have the normals of their points.
        rank, world: this process's number and how many there are; a batch is shared out evenly.
    """

    def __init__(
        self,
        dataset: Clouds,
        rows: NDArray[np.int64],
        protocol: Protocol,
        batch_size: int,
        seed: int,
        rank: int = 0,
        world: int = 1,
        normals: bool = False,
    ) -> None:
        self.dataset, self.rows, self.protocol, self.seed = dataset, rows, protocol, seed
        self.batch_size = min(batch_size, len(rows))
        self.rank, self.world, self.normals = rank, world, normals
        if self.batch_size < 2:
            raise InputError(
                f"training needs batches of 2 clouds or more, got batches of {batch_size} from "
                f"{len(rows)} clouds"
            )
        if self.batch_size % world:
            raise InputError(
                f"a batch of {self.batch_size} clouds cannot be shared evenly by {world} processes"
            )
        self.turns = turns_of(dataset.setting) if protocol.rotation == "so3" else "none"

    def __len__(self) -> int:
        """Batches an epoch."""
        return len(self.rows) // self.batch_size

    def order(self, epoch: int) -> NDArray[np.int64]:
        """The rows in the order in which ``epoch`` sees them."""
        return generator(self.seed, "order", epoch).permutation(self.rows)

    def make(self, place: Place, order: NDArray[np.int64]) -> Batch:
        """This process's share of one batch, on the CPU."""
        chosen = order[place.batch * self.batch_size : (place.batch + 1) * self.batch_size]
        rng = generator(self.seed, "augment", place.epoch, place.batch)
        distinct, normals = self.protocol.subset == "distinct", None
        if self.normals:
            points, normals = inputs.with_normals(self.dataset, chosen, rng, distinct)
        else:
            points = self.dataset.points(chosen, rng, distinct=distinct)
        rotation = self.dataset.rotations[chosen]
        if self.protocol.stretch > 1:
            points = stretched(
                points, rotation, self.dataset.symmetries[chosen], self.protocol.stretch, rng
            )
        if self.turns != "none":
            turn = self._turns(rng, len(chosen))
            points = points @ turn.swapaxes(1, 2).astype(np.float32)
            if normals is not None:
                normals = normals @ turn.swapaxes(1, 2).astype(np.float32)
            rotation = turn @ rotation
        if self.protocol.jitter_sigma > 0:
            noise = rng.standard_normal(points.shape, np.float32) * self.protocol.jitter_sigma
            points = points + noise.clip(-self.protocol.jitter_clip, self.protocol.jitter_clip)
        if not self.dataset.has_poses:
            rotation = np.full_like(rotation, np.nan)
        mine = slice(self.rank, None, self.world)
        mapped = rotation[mine]
        if self.dataset.has_poses:
            mapped = map_rotations(mapped, self.dataset.symmetries[chosen[mine]])
        return Batch(
            torch.from_numpy(np.ascontiguousarray(points[mine], np.float32)),
            torch.from_numpy(self.dataset.labels[chosen[mine]]),
            torch.from_numpy(rotation[mine].astype(np.float32)),
            torch.from_numpy(mapped.astype(np.float32)),
            None if normals is None else torch.from_numpy(np.ascontiguousarray(normals[mine])),
        )

    def _turns(self, rng: np.random.Generator, size: int) -> NDArray[np.float64]:
        if self.turns == "z":
            return axis_rotation("z", rng.uniform(0, 2 * np.pi, size))
        return haar_rotations(rng, size)

    def steps(self, first: int, last: int) -> Iterator[tuple[int, Place, Batch]]:
        """The batches of the steps from ``first`` up to, not with, ``last``, across epochs.

        The next batch is made while one is used.
        """
        epoch, order = -1, self.rows

        def make(step: int) -> tuple[int, Place, Batch]:
            nonlocal epoch, order
            place = Place(*divmod(step, len(self)))
            if place.epoch != epoch:
                epoch, order = place.epoch, self.order(place.epoch)
            return step, place, self.make(place, order)

        with ThreadPoolExecutor(1, thread_name_prefix="batches") as ahead:
            coming = ahead.submit(make, first) if first < last else None
            for step in range(first, last):
                assert coming is not None
                ready = coming.result()
                if step + 1 < last:
                    coming = ahead.submit(make, step + 1)
                yield ready
