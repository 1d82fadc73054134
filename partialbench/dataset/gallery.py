"""Clouds to turn by hand in a notebook: the page of ``show``, as an object that shows itself."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench import given
from partialbench.dataset import manifest as manifests
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.samples import Scene
from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.dataset.show import (
    POINTS,
    choose_rows,
    coloured,
    page_of,
    sample,
    samples_of,
    splat,
)
from partialbench.dataset.sources import View
from partialbench.errors import InputError

_ROW_PX = 330
"""Of a notebook's height, for a line of three samples."""


class Gallery:
    """Samples, each as its camera sees it and as a cloud to turn.

    Attributes:
        samples: how many. html: the page, one file that asks no other host for anything.
    """

    def __init__(self, heading: str, samples: list[dict[str, Any]]) -> None:
        self.samples = len(samples)
        self.html = page_of(heading, samples)

    def save(self, out: Path | str) -> Path:
        """Writes the page; returns its path."""
        out = given.path(out, "the page")
        make_folder(out.parent)
        write_atomically(out, self.html.encode())
        return out

    def __repr__(self) -> str:
        return f"<Gallery of {self.samples} clouds; .save('page.html') writes it>"

    def _repr_html_(self) -> str:
        height = _ROW_PX * -(-self.samples // 3) + 90
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" width="100%" height="{height}" '
            f'style="border: 0"></iframe>'
        )


def gallery(
    data: Any,
    R: ArrayLike | None = None,
    *,
    split: str | None = None,
    samples: int = 6,
    seed: int = 0,
) -> Gallery:
    """Clouds to turn by hand: a notebook shows the answer by itself, ``.save`` writes a page.

    Args:
        data: a data folder, a ``ShardDataset`` or ``TorchDataset``, a ``View``, or clouds (N,3),
            (B,N,3) or a list of any sizes, camera frame.
        R: the pose R_camera_object (3,3) or (B,3,3) of given clouds, drawn as the object's axes.
        split: of a data folder, "train" where it is not said.
        samples: how many rows of a data set.
        seed: which ones.

    Raises:
        InputError: nothing of the kind, or a pose or a split of what has its own.

    ::

        partialbench.show("data/pm40")
        partialbench.show(view)                       # of render_view
        partialbench.show(points, answer.rotation)    # a capture, with the pose that was found
    """
    shards = getattr(data, "shards", data)
    if isinstance(shards, str | Path):
        shards = given.path(shards, "the data folder")
        stored = int(manifests.load(shards).configuration["points"])
        split = "train" if split is None else split
        shards = ShardDataset(shards, split, min(POINTS, stored))
    own = getattr(shards, "split", None)  # of a data set that is open
    if split is not None and split != own:
        what = f"this data set is of {own!r}" if own else f"got a {type(data).__name__}"
        raise InputError(f"split={split!r} is for a data folder; {what}")
    if isinstance(shards, ShardDataset):
        if R is not None:
            raise InputError("R belongs to given clouds; a data set has its own poses")
        rows = choose_rows(shards.labels, samples, seed)
        return Gallery(f"{shards.dataset_id} · {shards.split}", samples_of(shards, rows))
    if isinstance(data, View):
        if R is not None:
            raise InputError("a View has its own pose; to draw another, give its points and R")
        title = f"{data.visible_fraction:.0%} of the surface seen"
        return Gallery("a view", [_sample(title, data.points, data.R_camera_object, data.depth)])
    clouds, _ = given.clouds(data, "a data folder, a data set, a View, or clouds (N,3) or (B,N,3)")
    for name, cloud in clouds:
        if not len(cloud):
            raise InputError(f"{name} has no points")
        if not np.isfinite(cloud).all():
            raise InputError(f"{name} has points that are NaN or infinite; leave them out")
    rotations: list[NDArray | None] = [None] * len(clouds)
    if R is not None:
        rotations = list(given.rotations(R, "R", len(clouds)))
    posed = enumerate(zip(clouds, rotations, strict=True))
    return Gallery(
        "clouds",
        [_sample(f"cloud {i}", cloud.astype(float), R) for i, ((_, cloud), R) in posed],
    )


def _sample(
    title: str, cloud: NDArray, R: NDArray | None, depth: NDArray | None = None
) -> dict[str, Any]:
    centre = cloud.mean(axis=0)
    points = cloud - centre
    size = max(1e-9, float(np.linalg.norm(points, axis=1).max()))
    scene = Scene(
        points / size,
        np.zeros((0, 3)),
        np.zeros((0, 3)) if R is None else np.asarray(R, np.float64).T,
        np.zeros((0, 2, 3)),
    )
    return sample(title, coloured(splat(cloud, centre) if depth is None else depth), scene)
