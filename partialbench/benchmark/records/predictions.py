"""What a model said about every test cloud: stored beside its record, so that every score can be
checked, and a new one needs no new run.

Scores are computed from what is stored, after rounding, and not from what the model returned: so
they can be recomputed to the last digit. The answer is not stored apart from its probability: it is
the first, most probable class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from partialbench.benchmark.records import archive
from partialbench.benchmark.records.testsets import GroundTruth
from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS

CLASSES_KEPT = 5
"""How many of the most probable classes are kept, with their probabilities."""
POSE_BINS_KEPT = 20
"""How many of the 60 pose bins are kept, best first: as far as the paper's k goes."""


@dataclass(frozen=True, eq=False)
class Predictions(GroundTruth):
    """What a model said about M test clouds, beside what is true of them.

    A test under another condition than trained on (fewer points, a sensor, a given pose) has the
    answer and its confidence alone: k = 1, one pose bin, nothing decided by several.

    Attributes:
        classes: (M,k) int16 the k ≤ 5 most probable of the *model's* classes, best first.
        log_probabilities: (M,k) float16 theirs, natural logarithm.
        shared: (M,1) int16 the most probable of the model's classes that the test data have too, or
            (M,0) where both have the same.
        pose_bins: (M,20) uint8 best first, (M,1), or (M,0) for a model without pose.
        decided: (M,k) int16, k ≤ 20, of a model that decides over several poses: the class for
            which the first 1, 2, … k ``pose_bins`` together decide; (M,0) for others.
        duplicate: (M,) bool, whether some training object was made from the same bytes.
    """

    classes: NDArray[np.int16]
    log_probabilities: NDArray[np.float16]
    shared: NDArray[np.int16]
    pose_bins: NDArray[np.uint8]
    decided: NDArray[np.int16]
    duplicate: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name in (*_ROWS, *_ANSWERS):
            if len(getattr(self, name)) != len(self.labels):
                raise ValueError(
                    f"{name} has {len(getattr(self, name))} rows, labels have {len(self.labels)}"
                )

    @property
    def predicted(self) -> NDArray[np.int16]:
        """(M,) the answer: index into the *model's* class names."""
        return self.classes[:, 0]

    def select(self, keep: NDArray) -> Predictions:
        """The clouds of a mask or of indices."""
        rows = {name: getattr(self, name)[keep] for name in (*_ROWS, *_ANSWERS)}
        return Predictions(**rows, class_names=self.class_names)


_ROWS = tuple(f.name for f in fields(GroundTruth) if f.name != "class_names")
_ANSWERS: dict[str, type[np.generic]] = {
    "classes": np.int16, "log_probabilities": np.float16, "shared": np.int16,
    "pose_bins": np.uint8, "decided": np.int16, "duplicate": np.bool_,
}  # fmt: skip


def deciding_classes(logits: NDArray, classes: NDArray) -> NDArray[np.int16]:
    """(M,k): column k − 1 is the class for which the k best poses decide.

    Args:
        logits, classes: (M,k) the highest class logit under each pose, best pose first, and its
            class.

    Source: Xu et al., "Ensemble strategy", as TerenceHsu666/PAPNet@878adcc does it: raw logits are
    compared, and of equal ones the more confident pose decides.
    """
    decided = np.zeros(logits.shape, np.int16)
    for k in range(1, logits.shape[1] + 1):
        loudest = logits[:, :k].argmax(axis=1)[:, None]
        decided[:, k - 1] = np.take_along_axis(classes, loudest, axis=1)[:, 0]
    return decided


def to_bytes(predictions: Predictions) -> bytes:
    """The answers, without the truth; the same predictions give the same bytes."""
    return archive.to_bytes({name: getattr(predictions, name) for name in _ANSWERS})


def from_bytes(
    data: bytes, path: Path, truth: GroundTruth, model_classes: Sequence[str]
) -> Predictions:
    """What ``to_bytes`` wrote, beside the truth it answers to.

    Raises:
        InputError: something else, or answers that this model cannot have given.
    """
    arrays = archive.from_bytes(data, _ANSWERS, path, "a prediction file")
    fault = _fault(arrays, truth, model_classes)
    if fault:
        raise InputError(f"{path} is not a prediction file of its record: {fault}")
    return Predictions(**{f.name: getattr(truth, f.name) for f in fields(GroundTruth)}, **arrays)


def _fault(arrays: dict[str, NDArray], truth: GroundTruth, model_classes: Sequence[str]) -> str:
    """The first thing that cannot be true, "" for nothing."""
    clouds, known = len(truth), len(model_classes)
    for name, values in arrays.items():
        if values.dtype != _ANSWERS[name]:
            return f"{name} is of type {values.dtype}, expected {np.dtype(_ANSWERS[name])}"
        if values.ndim != (1 if name == "duplicate" else 2) or len(values) != clouds:
            return f"{name} has shape {values.shape}, and there are {clouds} clouds"
    classes, logs = arrays["classes"], arrays["log_probabilities"].astype(float)
    shared, bins, decided = arrays["shared"], arrays["pose_bins"], arrays["decided"]
    if not 1 <= classes.shape[1] <= known or logs.shape != classes.shape:
        return f"{classes.shape[1]} classes a cloud with {logs.shape[1]} probabilities, of {known}"
    for name, numbers, end in (
        ("classes", classes, known), ("shared", shared, known), ("decided", decided, known),
        ("pose_bins", bins, NUM_BINS),
    ):  # fmt: skip
        if numbers.size and not 0 <= numbers.min() <= numbers.max() < end:
            return f"{name} must lie in [0, {end}), got {numbers.min()} to {numbers.max()}"
    for name, numbers in (("classes", classes), ("pose_bins", bins)):
        if (np.diff(np.sort(numbers, axis=1), axis=1) == 0).any():
            return f"{name} name one twice for a cloud"
    if not (np.isfinite(logs).all() and (logs <= 0).all() and (np.diff(logs, axis=1) <= 0).all()):
        return "the probabilities of a cloud are not finite, at most 1 and falling"
    # Rounding to float16 moves a probability by a two-thousandth at most.
    if (np.exp(logs).sum(axis=1) > 1.005).any():
        return "the probabilities of a cloud sum to more than 1"
    return _shared_fault(classes, shared, truth, model_classes)


def _shared_fault(
    classes: NDArray, shared: NDArray, truth: GroundTruth, model_classes: Sequence[str]
) -> str:
    """Whether the best shared class is the first of the stored ones that is shared."""
    same = list(model_classes) == truth.class_names.tolist()
    if shared.shape[1] != (0 if same else 1):
        return f"{shared.shape[1]} shared classes a cloud, expected {0 if same else 1}"
    if same:
        return ""
    is_shared = np.isin(np.array(model_classes, str), truth.class_names)
    if not is_shared[shared].all():
        return "a shared class is not one of the test data"
    among = is_shared[classes]
    first = np.take_along_axis(classes, among.argmax(axis=1)[:, None], axis=1)
    if (among.any(axis=1) & (first != shared)[:, 0]).any():
        return "a shared class is not the most probable one"
    return ""
