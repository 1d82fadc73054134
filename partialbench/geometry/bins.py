"""The 60 rotation bins of PAPNet: the icosahedral group in the order of the release.

Sixty rotations spread almost uniformly over SO(3) (every rotation lies within 44.5° of one). The
pose branch classifies into them. Source: TerenceHsu666/PAPNet@878adcc; the order is the release's,
so that its checkpoints mean the same here. SciPy's ``create_group("I")`` is another conjugate: it
shares only 12 elements with this one and equals it as a set after a 90° turn about x.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NUM_BINS = 60

F = (1 + 5**0.5) / 2  # the golden ratio
G = F - 1  # and its inverse

# Twice the unit quaternions (w, x, y, z): 2·(the icosians), one of each ± pair.
_TWICE_QUATERNIONS_WXYZ = (
    (2, 0, 0, 0), (G, 0, -F, -1), (F, -1, -G, 0), (F, 0, 1, G),
    (0, G, 1, F), (0, 0, 2, 0), (G, -F, -1, 0), (F, 0, -1, -G),
    (F, -G, 0, 1), (F, 1, G, 0), (G, 1, 0, F), (F, -1, G, 0),
    (G, 0, F, 1), (G, 0, F, -1), (G, F, 1, 0), (1, -1, -1, -1),
    (1, G, -F, 0), (1, -1, -1, 1), (1, 0, -G, -F), (1, F, 0, -G),
    (1, 1, -1, 1), (1, -G, -F, 0), (1, -F, 0, G), (1, 0, G, F),
    (1, -F, 0, -G), (1, -G, F, 0), (1, 0, G, -F), (1, G, F, 0),
    (0, F, G, 1), (1, -1, 1, 1), (0, 1, -F, G), (0, -1, -F, G),
    (1, 1, 1, 1), (G, -1, 0, -F), (0, 0, 0, 2), (F, G, 0, -1),
    (0, -F, G, 1), (0, 1, F, G), (G, 0, -F, 1), (0, F, G, -1),
    (F, 1, -G, 0), (1, 0, -G, F), (0, 2, 0, 0), (1, -1, 1, -1),
    (F, -G, 0, -1), (1, 1, 1, -1), (1, F, 0, G), (F, 0, -1, G),
    (G, -1, 0, F), (0, 1, -F, -G), (F, G, 0, 1), (0, F, -G, 1),
    (0, G, -1, F), (G, 1, 0, -F), (F, 0, 1, -G), (G, -F, 1, 0),
    (0, G, -1, -F), (G, F, -1, 0), (0, G, 1, -F), (1, 1, -1, -1),
)  # fmt: skip


@cache
def rotation_bins() -> NDArray[np.float64]:
    """The bins' rotations, (60,3,3) float64, read-only; index 0 is the identity."""
    wxyz = np.asarray(_TWICE_QUATERNIONS_WXYZ, dtype=np.float64) / 2
    bins = Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix()
    bins.setflags(write=False)
    return bins


def nearest_bins(rotation: NDArray, k: int = 1) -> NDArray[np.int64]:
    """Indices of the ``k`` nearest bins by geodesic angle, nearest first.

    Args:
        rotation: (…,3,3) rotations in the same sense as the labels (object → camera).
        k: how many, 1 ≤ k ≤ 60.

    Returns:
        (…,k) int64. Equal angles are ordered by bin index.
    """
    if not 1 <= k <= NUM_BINS:
        raise ValueError(f"k must be between 1 and {NUM_BINS}, got {k}")
    # The angle falls as the trace of A·Bᵀ rises, and that trace is the sum of products.
    similarity = np.einsum("...ij,bij->...b", np.asarray(rotation, np.float64), rotation_bins())
    # Round so that true ties are not decided by the last bit.
    return np.argsort(-np.round(similarity, 12), axis=-1, kind="stable")[..., :k]
