"""Object symmetries: the paper's table 3, its Map operator, and pose error modulo symmetry.

A symmetry S maps the object onto itself in its own frame, so R and R·S show the same picture.
The paper's Map (eq. 6, after Pitteri et al. 2019) picks the member of {R·S} nearest the identity.
The release applies X-, Y- and Z-180 one after the other, which is not that argmin: wrong for 8.5 %
of random rotations. Here Map runs over the whole group.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from partialbench.geometry.rotations import axis_rotation, geodesic_angle


@dataclass(frozen=True)
class Symmetry:
    """A symmetry group about the object's own axes.

    Attributes:
        name: "none", "x-180", "y-180", "z-180", "xyz-180", "z-90" (four-fold) or "z-inf".
        elements: (G,3,3) float64, the finite part of the group, identity first.
        continuous: whether every turn about z is a symmetry as well.
    """

    name: str
    elements: NDArray[np.float64]
    continuous: bool = False


def _finite(name: str, *turns: tuple[str, float]) -> Symmetry:
    elements = np.stack([np.eye(3), *(np.round(axis_rotation(a, t), 15) for a, t in turns)])
    elements.setflags(write=False)
    return Symmetry(name, elements)


GROUPS: dict[str, Symmetry] = {
    "none": _finite("none"),
    "x-180": _finite("x-180", ("x", np.pi)),
    "y-180": _finite("y-180", ("y", np.pi)),
    "z-180": _finite("z-180", ("z", np.pi)),
    "xyz-180": _finite("xyz-180", ("x", np.pi), ("y", np.pi), ("z", np.pi)),
    "z-90": _finite("z-90", ("z", np.pi / 2), ("z", np.pi), ("z", 3 * np.pi / 2)),
    "z-inf": Symmetry("z-inf", np.eye(3)[None], continuous=True),
}
"""Every group the data sets use. z-90 is Scan2CAD's ``__SYM_ROTATE_UP_4``."""

_CLASSES = {
    "xyz-180": "bookshelf curtain door dresser glass_box keyboard radio wardrobe xbox",
    "z-inf": "bottle bowl cone cup flower_pot lamp plant stool vase",
    "z-180": "bathtub night_stand table tent tv_stand",
    "y-180": "guitar",
}
CLASS_SYMMETRY: dict[str, str] = {
    name: group for group, names in _CLASSES.items() for name in names.split()
}
"""Class name → group name (paper, table 3); a class that is not listed has none."""


def symmetry_of(class_name: str) -> Symmetry:
    """The symmetry of a PM40 class by name; "none" for a class the paper's table does not list."""
    return GROUPS[CLASS_SYMMETRY.get(class_name, "none")]


def map_rotation(rotation: NDArray, symmetry: Symmetry) -> NDArray[np.float64]:
    """The paper's Map: the member of {R·S⁻¹ : S in the group} nearest the identity.

    Args:
        rotation: (…,3,3) object → camera rotations.
        symmetry: the object's group.

    Returns:
        (…,3,3) float64. Nearest in the Frobenius norm, which orders rotations as the angle does.
        Ties (a set of measure zero) go to the element listed first, so the identity wins.

    Source: paper eq. 6 and 7; for z-inf, θ = atan2(R₂₁ − R₁₂, R₁₁ + R₂₂) and R·Rz(θ)⁻¹.
    """
    rotation = np.asarray(rotation, np.float64)
    if symmetry.continuous:
        theta = np.arctan2(
            rotation[..., 1, 0] - rotation[..., 0, 1], rotation[..., 0, 0] + rotation[..., 1, 1]
        )
        return rotation @ axis_rotation("z", -theta)
    candidates = rotation[..., None, :, :] @ np.swapaxes(symmetry.elements, -1, -2)
    # ‖M − I‖² = 6 − 2·tr M: the nearest has the largest trace.
    traces = np.round(np.trace(candidates, axis1=-2, axis2=-1), 12)
    best = traces.argmax(axis=-1)
    return np.take_along_axis(candidates, best[..., None, None, None], axis=-3)[..., 0, :, :]


def pose_error(predicted: NDArray, true: NDArray, symmetry: Symmetry) -> NDArray[np.float64]:
    """Geodesic error modulo symmetry: the least angle between ``predicted`` and any true·S.

    Args:
        predicted, true: broadcastable (…,3,3) object → camera rotations.

    Returns:
        (…) radians in [0, π]. For z-inf the least angle over all turns has a closed form: with
        Q = trueᵀ·predicted, max over θ of tr(Rz(θ)ᵀQ) = Q₃₃ + √((Q₁₁+Q₂₂)² + (Q₂₁−Q₁₂)²).
    """
    predicted, true = np.asarray(predicted, np.float64), np.asarray(true, np.float64)
    if symmetry.continuous:
        q = np.swapaxes(true, -1, -2) @ predicted
        theta = np.arctan2(q[..., 1, 0] - q[..., 0, 1], q[..., 0, 0] + q[..., 1, 1])
        return geodesic_angle(predicted, true @ axis_rotation("z", theta))
    equivalent = true[..., None, :, :] @ symmetry.elements
    return geodesic_angle(predicted[..., None, :, :], equivalent).min(axis=-1)


def map_rotations(rotation: NDArray, symmetries: NDArray[np.str_]) -> NDArray[np.float64]:
    """``map_rotation`` for rows of mixed symmetry.

    Args:
        rotation: (B,3,3) object → camera.
        symmetries: (B,) group names.
    """
    mapped = np.array(rotation, np.float64)
    for name in set(symmetries.tolist()):
        rows = symmetries == name
        mapped[rows] = map_rotation(mapped[rows], GROUPS[name])
    return mapped
