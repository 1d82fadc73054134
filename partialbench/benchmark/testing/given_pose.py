"""A pose told to the model with each test cloud: what of its error is the pose's, what the class's.

After the paper's upper bound (table 2, ground-truth pose at test) and its noise U(−δ, δ) on every
Euler angle. Source: Xu et al., arXiv:2012.10042v2.
"""

from __future__ import annotations

import inspect
import math

import numpy as np
from numpy.typing import NDArray
from torch import nn

from partialbench.benchmark.clouds import Clouds
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.rotations import euler_noise, haar_rotations
from partialbench.geometry.symmetry import map_rotations

RANDOM = "random"
ARGUMENT = "rotation"
"""What a model's ``forward`` calls the pose: (B,3,3), object → camera."""


def parse(text: str | float) -> str:
    """A given pose as records name it: "0" is the true one, "15" has noise, or "random".

    Raises:
        InputError: neither "random" nor a number of degrees from 0 to 180.
    """
    if text == RANDOM:
        return RANDOM
    try:
        delta_deg = float(text)
    except ValueError:
        delta_deg = math.nan
    if not 0 <= delta_deg <= 180:
        raise InputError(
            f"a test pose is '{RANDOM}' or the half width in degrees of the noise on each Euler "
            f"angle of the true pose, 0 to 180 (0: the true pose itself); got {text!r}"
        )
    return f"{delta_deg:g}"


def rotations(name: str, dataset: Clouds, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """What is told of the poses of some rows of a test split.

    Args:
        name: see ``parse``.

    Returns:
        (M,3,3) object → camera: Rz(c)·Ry(b)·Rx(a)·Map(R) with the label R under the symmetry of its
        class and every angle from U(−δ, δ), or a rotation uniform on SO(3). The same for every
        model, whatever its batches.

    Raises:
        InputError: nobody knows the poses of this data set.
    """
    if not getattr(dataset, "has_poses", True):
        raise InputError(f"{dataset.dataset_id} has no poses, so none can be given to a model")
    rng = generator(0, "given pose", name)
    if name == RANDOM:
        return haar_rotations(rng, len(rows)).astype(np.float32)
    true = map_rotations(dataset.rotations[rows], dataset.symmetries[rows])
    return (euler_noise(rng, len(rows), math.radians(float(name))) @ true).astype(np.float32)


def require_taken(model: nn.Module, name: str) -> None:
    """Raises ``InputError`` where the model's ``forward`` takes no pose."""
    if ARGUMENT not in inspect.signature(model.forward).parameters:
        raise InputError(
            f"{name} takes no pose, so none can be given to it: its forward would need an argument "
            f"{ARGUMENT!r}, (B,3,3) object → camera, as papnet and papnet-steered have"
        )
