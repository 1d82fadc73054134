"""What a model said about every test cloud: stored beside its record, so that a new metric needs
no new run, and so that every score can be checked.

Scores are computed from what is stored, after rounding, and not from what the model returned: so
they can be recomputed to the last digit.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from partialbench.errors import InputError

POSE_BINS_KEPT = 20
"""How many of the 60 pose bins are kept, best first: as far as the paper's k goes."""


@dataclass(frozen=True, eq=False)
class Predictions:
    """M test clouds, in the order of the data set's rows.

    Attributes:
        rows: (M,) int32 row numbers of the test split.
        labels: (M,) int16 true class, index into the *test* data's class names.
        predicted: (M,) int16 most probable class, index into the *model's* class names.
        log_probabilities: (M,K) float16 over the model's classes, natural logarithm.
        pose_bins: (M,20) uint8 best first, or (M,0) for a model without pose.
        candidate_logits, candidate_classes: (M,k) float32 and int16, k ≤ 20, of a model that
            decides over k poses: the highest class logit under each of the first k ``pose_bins``
            and its class; (M,0) for others.
        quaternions: (M,4) float32 R_camera_object as x, y, z, w; see ``rotations``.
        symmetries: (M,) str group names.
        object_ids: (M,) str. views: (M,) int32. visible_fraction: (M,) float32.
        duplicate: (M,) bool, whether some training object was made from the same bytes.
    """

    rows: NDArray[np.int32]
    labels: NDArray[np.int16]
    predicted: NDArray[np.int16]
    log_probabilities: NDArray[np.float16]
    pose_bins: NDArray[np.uint8]
    candidate_logits: NDArray[np.float32]
    candidate_classes: NDArray[np.int16]
    quaternions: NDArray[np.float32]
    symmetries: NDArray[np.str_]
    object_ids: NDArray[np.str_]
    views: NDArray[np.int32]
    visible_fraction: NDArray[np.float32]
    duplicate: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.labels)

    def __post_init__(self) -> None:
        for field in fields(self):
            if len(getattr(self, field.name)) != len(self.labels):
                raise ValueError(
                    f"{field.name} has {len(getattr(self, field.name))} rows, labels have "
                    f"{len(self.labels)}"
                )

    @property
    def rotations(self) -> NDArray[np.float64]:
        """(M,3,3) R_camera_object, rotations to the last bit of float64.

        A rounded matrix would not be: an eighth of the mapped poses of objects with z-inf symmetry
        lie exactly between two bins, and which is "the nearest" must not hang on rounding.
        """
        return Rotation.from_quat(self.quaternions.astype(np.float64)).as_matrix()

    def select(self, keep: NDArray) -> Predictions:
        """The clouds of a mask or of indices."""
        return Predictions(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})


def to_bytes(predictions: Predictions) -> bytes:
    """A compressed .npz; the same predictions give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for field in fields(predictions):
            array = io.BytesIO()
            np.lib.format.write_array(array, getattr(predictions, field.name), allow_pickle=False)
            # A fixed time: numpy.savez would write the clock into the bytes.
            info = zipfile.ZipInfo(f"{field.name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, array.getvalue())
    return buffer.getvalue()


def load(path: Path) -> Predictions:
    """Raises ``InputError`` where the file is absent or is not what ``to_bytes`` wrote."""
    if not path.is_file():
        raise InputError(f"the prediction file {path} is missing")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return Predictions(**{f.name: archive[f.name] for f in fields(Predictions)})
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is not a prediction file: {error}") from error
