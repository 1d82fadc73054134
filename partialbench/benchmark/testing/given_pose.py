"""A pose told to the model with each test cloud: what of its error is the pose's, what the class's.

After the paper's upper bound (table 2, ground-truth pose at test) and its noise U(−δ, δ) on every
Euler angle. Source: Xu et al., arXiv:2012.10042v2.

A label is mapped under the symmetry of its class, so the told pose says something of the class: a
bottle's never has a turn about its axis. Under "class:0" a model is asked once for each symmetry
group instead, with the pose as that group maps it, and each class's logit is taken from the answer
under its own group's. What it is told is then a function of a rotation that is uniform whatever the
class, and cannot carry it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from partialbench.benchmark.clouds import Clouds
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.rotations import euler_noise, haar_rotations
from partialbench.geometry.symmetry import CLASS_SYMMETRY, GROUPS, map_rotation, map_rotations

if TYPE_CHECKING:
    from torch import nn

if TYPE_CHECKING:
    from torch import nn

RANDOM = "random"
PER_CLASS = "class:"
"""Before the degrees: told under each class's own symmetry, not under the true class's."""
ARGUMENT = "rotation"
"""What a model's ``forward`` calls the pose: (B,3,3), object → camera."""


class Told(NamedTuple):
    """What a model is told of the poses of M clouds.

    Attributes:
        rotations: (M,G,3,3) float32 object → camera; the model answers under each of the G.
        hypothesis: (K,) int64, under which of the G each of the model's classes is judged.
    """

    rotations: NDArray[np.float32]
    hypothesis: NDArray[np.int64]


def parse(text: str | float) -> str:
    """A given pose as records name it: "0" is the true one, "15" has noise, "class:0" and
    "class:15" the same under each class's own symmetry, or "random".

    Raises:
        InputError: none of these; noise is a number of degrees from 0 to 180.
    """
    if text == RANDOM:
        return RANDOM
    prefix = PER_CLASS if isinstance(text, str) and text.startswith(PER_CLASS) else ""
    try:
        delta = float(str(text)[len(prefix) :])
    except (TypeError, ValueError):
        delta = math.nan
    if not 0 <= delta <= 180:
        raise InputError(
            f"a test pose is '{RANDOM}' or the half width in degrees of the noise on each Euler "
            f"angle of the true pose, 0 to 180 (0: the true pose itself), or '{PER_CLASS}' and "
            f"that for the pose under each class's own symmetry; got {text!r}"
        )
    return f"{prefix}{delta:g}"


def delta_deg(name: str) -> float:
    """The noise of a pose that ``parse`` named, but for "random", in degrees."""
    return float(name.removeprefix(PER_CLASS))


def told(name: str, dataset: Clouds, rows: NDArray[np.int64], class_names: Sequence[str]) -> Told:
    """What a model with these classes is told of some rows of a test split.

    Args:
        name: see ``parse``.

    Raises:
        InputError: nobody knows the poses of this data set; or they are asked for under each
            class's symmetry, and a class has objects of several.
    """
    if not name.startswith(PER_CLASS):
        single = rotations(name, dataset, rows)[:, None]
        return Told(single, np.zeros(len(class_names), np.int64))
    _require_poses(dataset)
    of_class = [_symmetry_of(each, dataset) for each in class_names]
    groups = sorted(set(of_class))
    noise = _noise(name, len(rows))
    mapped = [noise @ map_rotation(dataset.rotations[rows], GROUPS[group]) for group in groups]
    return Told(
        np.stack(mapped, axis=1).astype(np.float32),
        np.array([groups.index(group) for group in of_class]),
    )


def _symmetry_of(class_name: str, dataset: Clouds) -> str:
    """The symmetry by which a class's labels are mapped: the data's own, or, of a class that they
    have no object of, the paper's."""
    names = list(dataset.class_names)
    of_class = dataset.labels == (names.index(class_name) if class_name in names else -1)
    found = sorted(set(dataset.symmetries[of_class].tolist()))
    if len(found) > 1:
        raise InputError(
            f"the objects of class {class_name!r} of {dataset.dataset_id} have symmetries of their "
            f"own ({', '.join(found)}), so there is none of the class to tell a pose under; give "
            f"the true pose, without '{PER_CLASS}'"
        )
    return found[0] if found else CLASS_SYMMETRY.get(class_name, "none")


def _require_poses(dataset: Clouds) -> None:
    if not getattr(dataset, "has_poses", True):
        raise InputError(f"{dataset.dataset_id} has no poses, so none can be given to a model")


def _noise(name: str, count: int) -> NDArray[np.float64]:
    """(count,3,3); the same with and without ``PER_CLASS``."""
    delta = delta_deg(name)
    rng = generator(0, "given pose", f"{delta:g}")
    return euler_noise(rng, count, math.radians(delta))


def rotations(name: str, dataset: Clouds, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """One pose for each of some rows of a test split.

    Args:
        name: see ``parse``; none under each class's own symmetry.

    Returns:
        (M,3,3) object → camera: Rz(c)·Ry(b)·Rx(a)·Map(R) with the label R under the symmetry of its
        class and every angle from U(−δ, δ), or a rotation uniform on SO(3). The same for every
        model, whatever its batches.

    Raises:
        InputError: nobody knows the poses of this data set.
    """
    _require_poses(dataset)
    if name == RANDOM:
        rng = generator(0, "given pose", name)
        return haar_rotations(rng, len(rows)).astype(np.float32)
    true = map_rotations(dataset.rotations[rows], dataset.symmetries[rows])
    return (_noise(name, len(rows)) @ true).astype(np.float32)


def require_taken(model: nn.Module, name: str) -> None:
    """Raises ``InputError`` where the model's ``forward`` takes no pose."""
    if ARGUMENT not in inspect.signature(model.forward).parameters:
        raise InputError(
            f"{name} takes no pose, so none can be given to it: its forward would need an argument "
            f"{ARGUMENT!r}, (B,3,3) object → camera, as papnet and papnet-steered have"
        )
