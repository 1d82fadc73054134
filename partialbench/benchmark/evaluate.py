"""Running a trained model over test clouds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import nn

from partialbench.benchmark import duplicates, inputs
from partialbench.benchmark.batches import Clouds
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.prediction import Prediction
from partialbench.benchmark.predictions import POSE_BINS_KEPT, Predictions
from partialbench.errors import PartialbenchError


class NotFiniteError(PartialbenchError):
    """A model's answer holds NaN or infinity."""


def run_model(
    model: nn.Module,
    dataset: Clouds,
    rows: NDArray[np.int64],
    num_classes: int,
    device: torch.device | str = "cpu",
    batch_size: int = 32,
    given: NDArray[np.float32] | None = None,
) -> Iterator[tuple[NDArray[np.int64], Prediction]]:
    """The model's answers for ``rows``, batch by batch, in evaluation mode and full precision.

    Clouds are the first points of the stored order: no randomness, no augmentation, no votes.

    Args:
        given: (M,3,3) poses told to the model, object → camera; by default it has its own.
    """
    model.eval()
    for start in range(0, len(rows), batch_size):
        chosen = rows[start : start + batch_size]
        points, more = inputs.of_rows(model, dataset, chosen, device)
        # Not around the yield: a generator must not leave its caller without gradients.
        with torch.inference_mode():
            if given is None:
                output = model(points, **more)
            else:
                told = torch.from_numpy(given[start : start + batch_size]).to(device)
                output = model(points, rotation=told, **more)
        yield chosen, as_prediction(output, len(chosen), num_classes)


def predict_rows(
    model: nn.Module,
    dataset: Clouds,
    rows: NDArray[np.int64],
    num_classes: int,
    device: torch.device | str = "cpu",
    batch_size: int = 32,
    train_sources: Sequence[str] = (),
    given: NDArray[np.float32] | None = None,
) -> Predictions:
    """Predictions for ``rows`` of a test split.

    Args:
        num_classes: of the model, which may have been trained on other classes than ``dataset``'s.
        train_sources: ``duplicates.source_keys`` of the training data.
        given: see ``run_model``.

    Raises:
        NotFiniteError: an answer with NaN or infinity.
    """
    if len(rows) == 0:
        raise ValueError("there is nothing to evaluate: no rows")
    predicted, logs, bins, scores, classes = [], [], [], [], []
    answers = run_model(model, dataset, rows, num_classes, device, batch_size, given)
    for chosen, prediction in answers:
        logits = prediction.class_logits.double()
        if not bool(torch.isfinite(logits).all()):
            bad = int((~torch.isfinite(logits)).any(dim=1).sum())
            raise NotFiniteError(
                f"{bad} of {len(chosen)} clouds (rows {chosen[0]} to {chosen[-1]}) got class "
                f"logits that are not finite; the model is broken or its weights are"
            )
        predicted.append(logits.argmax(dim=1).cpu())
        logs.append(logits.log_softmax(dim=1).cpu())
        if prediction.pose_logits is not None:
            order = prediction.pose_logits.argsort(dim=1, descending=True, stable=True)
            bins.append(order[:, :POSE_BINS_KEPT].cpu())
        if prediction.candidates is not None:
            scores.append(prediction.candidates[0][:, :POSE_BINS_KEPT].float().cpu())
            classes.append(prediction.candidates[1][:, :POSE_BINS_KEPT].cpu())
    # float16 ends at −65504; beyond that a probability is zero anyway.
    log_probabilities = torch.cat(logs).clamp(min=-60_000).numpy().astype(np.float16)
    nothing = np.zeros((len(rows), 0))
    pose_bins, logits_under_poses, classes_under_poses = (
        torch.cat(found).numpy() if found else nothing for found in (bins, scores, classes)
    )
    return Predictions(
        rows=rows.astype(np.int32),
        labels=dataset.labels[rows].astype(np.int16),
        predicted=torch.cat(predicted).numpy().astype(np.int16),
        log_probabilities=log_probabilities,
        pose_bins=pose_bins.astype(np.uint8),
        candidate_logits=logits_under_poses.astype(np.float32),
        candidate_classes=classes_under_poses.astype(np.int16),
        quaternions=Rotation.from_matrix(dataset.rotations[rows]).as_quat().astype(np.float32),
        symmetries=dataset.symmetries[rows],
        object_ids=dataset.object_ids[rows],
        views=dataset.views[rows].astype(np.int32),
        visible_fraction=dataset.visible_fraction[rows].astype(np.float32),
        duplicate=duplicates.among(dataset.source_digests[rows], list(train_sources)),
    )


def quick_accuracy(
    model: nn.Module, dataset: Clouds, rows: NDArray[np.int64], device: torch.device | str
) -> float | None:
    """Share of ``rows`` classified rightly, for the training log; None where there are no rows."""
    if len(rows) == 0:
        return None
    hits = 0
    for chosen, prediction in run_model(model, dataset, rows, len(dataset.class_names), device):
        answer = prediction.class_logits.argmax(dim=1).cpu().numpy()
        hits += int((answer == dataset.labels[chosen]).sum())
    return hits / len(rows)
