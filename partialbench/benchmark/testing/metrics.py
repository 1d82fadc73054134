"""Scores from predictions. Pure NumPy; every degenerate input has a written meaning.

Accuracies are shares in [0, 1]; angles are degrees where the name says so. A score with nothing to
average over (a class without test clouds, a model without pose) is None, never 0 and never NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.benchmark.records.predictions import Predictions
from partialbench.geometry.bins import nearest_bins, rotation_bins
from partialbench.geometry.symmetry import GROUPS, map_rotations, pose_error

VISIBILITY_EDGES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 1.0)


def confusion(labels: NDArray, predicted: NDArray, num_classes: int) -> NDArray[np.int64]:
    """Counts (K,K): row = true class, column = predicted class."""
    labels, predicted = _same_length(labels, predicted)
    for name, values in (("labels", labels), ("predicted", predicted)):
        if values.size and not 0 <= values.min() <= values.max() < num_classes:
            raise ValueError(
                f"{name} must lie in [0, {num_classes}), got {values.min()} to {values.max()}"
            )
    flat = np.bincount(labels * num_classes + predicted, minlength=num_classes**2)
    return flat.reshape(num_classes, num_classes)


def accuracy(labels: NDArray, predicted: NDArray) -> float:
    """Share of clouds whose class is right."""
    labels, predicted = _same_length(labels, predicted)
    return float((labels == predicted).mean())


def per_class_accuracy(labels: NDArray, predicted: NDArray, num_classes: int) -> list[float | None]:
    """Share of each true class's clouds that are right; None for a class with no test cloud."""
    counts = confusion(labels, predicted, num_classes)
    totals = counts.sum(axis=1)
    return [float(counts[k, k] / totals[k]) if totals[k] else None for k in range(num_classes)]


def class_accuracy(labels: NDArray, predicted: NDArray, num_classes: int) -> float:
    """Mean of the per-class accuracies over the classes that have test clouds.

    A class that is predicted but has no test cloud does not enter (torchmetrics' macro average
    counts it as 0); scikit-learn's ``balanced_accuracy_score`` is the same as this.
    """
    values = [v for v in per_class_accuracy(labels, predicted, num_classes) if v is not None]
    return float(np.mean(values))


def calibration_error(confidences: NDArray, correct: NDArray, num_bins: int = 15) -> float:
    """Expected calibration error: the mean gap between confidence and accuracy over equal bins.

    Args:
        confidences: (M,) probability of the predicted class, in [0, 1].
        correct: (M,) bool.

    Source: Guo et al. 2017, eq. 3, bins (i/n, (i+1)/n]; an empty bin adds nothing.
    """
    confidences, correct = _same_length(confidences, correct)
    if confidences.min() < 0 or confidences.max() > 1 + 1e-6:
        raise ValueError(
            f"confidences must lie in [0, 1], got {confidences.min()} to {confidences.max()}"
        )
    which = np.clip(np.ceil(confidences * num_bins).astype(int) - 1, 0, num_bins - 1)
    gaps = np.bincount(which, weights=confidences - correct.astype(float), minlength=num_bins)
    return float(np.abs(gaps).sum() / len(confidences))


def true_pose_bins(rotations: NDArray, symmetries: NDArray[np.str_]) -> NDArray[np.int64]:
    """(M,) the bin nearest to each mapped rotation: the paper's pose label."""
    return nearest_bins(map_rotations(rotations, symmetries))[:, 0]


def pose_errors_deg(
    predicted: NDArray, rotations: NDArray, symmetries: NDArray[np.str_]
) -> NDArray[np.float64]:
    """(M,) geodesic error modulo each row's symmetry, degrees, of (M,3,3) predicted rotations."""
    errors = np.zeros(len(rotations))
    for name in set(symmetries.tolist()):
        rows = symmetries == name
        errors[rows] = pose_error(predicted[rows], rotations[rows], GROUPS[name])
    return np.degrees(errors)


def best_pose_errors_deg(predictions: Predictions) -> NDArray[np.float64]:
    """(M,) the same of the most probable bin's rotation, for a model that has a pose."""
    best = rotation_bins()[predictions.pose_bins[:, 0]]
    return pose_errors_deg(best, predictions.rotations, predictions.symmetries)


def pose_hits(predictions: Predictions) -> NDArray[np.bool_]:
    """(M,k), k ≤ 20: column k − 1 says whether a cloud's ``true_pose_bins`` is among the k best."""
    true = true_pose_bins(predictions.rotations, predictions.symmetries)
    return np.logical_or.accumulate(predictions.pose_bins == true[:, None], axis=1)


def pose_scores(predictions: Predictions) -> dict[str, Any] | None:
    """Pose scores of a model that has a pose; None for one that has not.

    Returns:
        ``top_k``: for k = 1, 2, …, the share of clouds whose true bin (``true_pose_bins``) is
        among the k best; and of the best bin's rotation, the geodesic error modulo symmetry:
        ``mean_deg``, ``median_deg``, ``within_15``, ``within_30`` (shares). The bins are 44° wide,
        so even the right bin errs by 29° on average for an object without symmetry.
    """
    if predictions.pose_bins.shape[1] == 0:
        return None
    errors = best_pose_errors_deg(predictions)
    return {
        "top_k": [float(v) for v in pose_hits(predictions).mean(axis=0)],
        "mean_deg": float(errors.mean()),
        "median_deg": float(np.median(errors)),
        "within_15": float((errors < 15).mean()),
        "within_30": float((errors < 30).mean()),
    }


def ensemble_accuracy(decided: NDArray, labels: NDArray) -> list[float] | None:
    """For k = 1, 2, …: the share of clouds that are right when their k best poses decide.

    Args:
        decided: (M,k), see ``Predictions``. labels: (M,).

    Returns:
        None for a model that does not decide over poses.
    """
    if decided.shape[1] == 0:
        return None
    return [float(share) for share in (decided == labels[:, None]).mean(axis=0)]


def visibility_bins(
    visible_fraction: NDArray, edges: Sequence[float] = VISIBILITY_EDGES
) -> NDArray[np.int64]:
    """(M,) which bin [edge, next edge) each cloud falls in; the last includes 1."""
    return np.clip(np.digitize(visible_fraction, edges) - 1, 0, len(edges) - 2)


def by_visibility(
    correct: NDArray, visible_fraction: NDArray, edges: Sequence[float] = VISIBILITY_EDGES
) -> list[dict[str, Any]]:
    """Accuracy of the clouds in each of ``visibility_bins``; None in a bin without clouds."""
    which = visibility_bins(visible_fraction, edges)
    return [
        {
            "from": edges[i],
            "to": edges[i + 1],
            "clouds": int((which == i).sum()),
            "accuracy": float(correct[which == i].mean()) if (which == i).any() else None,
        }
        for i in range(len(edges) - 1)
    ]


def shared_clouds(
    predictions: Predictions, model_classes: Sequence[str], test_classes: Sequence[str]
) -> tuple[Predictions, NDArray[np.int64]]:
    """The clouds whose class the model knows, by name, and their labels among *its* classes.

    Raises:
        ValueError: there is none.
    """
    names = list(model_classes)
    to_model = np.array([names.index(c) if c in names else -1 for c in test_classes])
    label = to_model[predictions.labels]
    if not (label >= 0).any():
        raise ValueError(
            f"no test cloud has a class the model knows: {list(test_classes)} against {names}"
        )
    return predictions.select(label >= 0), label[label >= 0]


def scores(
    predictions: Predictions, model_classes: Sequence[str], test_classes: Sequence[str]
) -> dict[str, Any]:
    """Every score of a record, from its stored predictions.

    Where the test data have other classes than the model (trained on another data set), only
    clouds of shared classes count, and classes are matched by name. Then ``accuracy`` leaves the
    model all its outputs, as the PAPNet release does; ``restricted_accuracy`` lets it answer only
    with a shared class. With equal classes the two are the same. The scores "without duplicates"
    leave out the clouds of objects that a training object was made of as well; None where none
    remains. ``ensemble`` is ``ensemble_accuracy``.
    """
    names = list(model_classes)
    p, label = shared_clouds(predictions, names, test_classes)
    predicted = p.predicted.astype(np.int64)
    confidence = np.exp(p.log_probabilities[:, 0].astype(np.float64))
    restricted = p.shared[:, 0].astype(np.int64) if p.shared.shape[1] else predicted
    per_class = per_class_accuracy(label, predicted, len(names))
    own = ~p.duplicate
    alone = (label[own], predicted[own])
    return {
        "clouds": len(p),
        "objects": len(np.unique(p.object_ids)),
        "accuracy": accuracy(label, predicted),
        "class_accuracy": class_accuracy(label, predicted, len(names)),
        "restricted_accuracy": accuracy(label, restricted),
        "restricted_class_accuracy": class_accuracy(label, restricted, len(names)),
        "duplicates": int(p.duplicate.sum()),
        "accuracy_without_duplicates": accuracy(*alone) if own.any() else None,
        "class_accuracy_without_duplicates": (
            class_accuracy(*alone, len(names)) if own.any() else None
        ),
        "per_class": dict(zip(names, per_class, strict=True)),
        "calibration_error": calibration_error(confidence.clip(max=1), predicted == label),
        "visibility": by_visibility(predicted == label, p.visible_fraction),
        "pose": pose_scores(p),
        "ensemble": ensemble_accuracy(p.decided, label),
    }


def _same_length(a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    a, b = np.asarray(a), np.asarray(b)
    if a.ndim != 1 or a.shape != b.shape or len(a) == 0:
        raise ValueError(
            f"expected two arrays of one length, at least 1; got {a.shape} and {b.shape}"
        )
    return (a.astype(np.int64), b.astype(np.int64)) if a.dtype.kind in "iu" else (a, b)
