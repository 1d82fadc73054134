"""Running a trained model over test clouds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from partialbench.benchmark import inputs
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.prediction import Prediction
from partialbench.benchmark.records import testsets
from partialbench.benchmark.records.predictions import (
    CLASSES_KEPT,
    POSE_BINS_KEPT,
    Predictions,
    deciding_classes,
)
from partialbench.benchmark.testing import duplicates
from partialbench.benchmark.testing.given_pose import ARGUMENT, Told
from partialbench.benchmark.testing.isolation import State, keyed_draws, unchanged
from partialbench.dataset.seeding import generator
from partialbench.errors import PartialbenchError


class NotFiniteError(PartialbenchError):
    """A model's answer holds class logits that are no finite numbers, or pose logits that are none.

    Sorted they would still give a class and a pose.

    Attributes:
        what: "class logits that are not finite" and the like.
    """

    def __init__(self, message: str, what: str) -> None:
        super().__init__(message)
        self.what = what


def run_model(
    model: nn.Module,
    dataset: Clouds,
    rows: NDArray[np.int64],
    num_classes: int,
    device: torch.device | str = "cpu",
    batch_size: int = 32,
    given: Told | None = None,
) -> Iterator[tuple[NDArray[np.int64], Prediction]]:
    """The model's answers for ``rows``, batch by batch, in evaluation mode and full precision.

    Clouds are the first points of the stored order: no augmentation, no votes. What a model itself
    draws is keyed by the batch, and after each it is what it was: no batch sees an earlier one.

    Args:
        given: what is told of the poses of ``rows``; by default the model has its own. Under
            several, each class's logit is of the answer under its own; the rest of the first's.

    Raises:
        NotFiniteError: see there.
    """
    model.eval()
    state = State(model)
    for start in range(0, len(rows), batch_size):
        chosen = rows[start : start + batch_size]
        points, beside = inputs.of_rows(model, dataset, chosen, device)
        # Not around the yield: a generator must not leave its caller without gradients.
        with torch.inference_mode():
            if given is None:
                poses: list[dict[str, Tensor]] = [{}]
            else:
                of_batch = torch.from_numpy(given.rotations[start : start + batch_size]).to(device)
                poses = [{ARGUMENT: each} for each in of_batch.unbind(1)]
            answers = []
            for pose in poses:
                # Copies: a model may change what it is given, and is asked again.
                named = {name: value.clone() for name, value in beside.items()}
                with unchanged(model, state), keyed_draws(start, device=device):
                    output = model(points.clone(), **named, **pose)
                answer = as_prediction(output, len(chosen), num_classes)
                _require_finite(answer, chosen)
                answers.append(answer)
            prediction = answers[0]
            if given is not None and len(answers) > 1:
                prediction = prediction._replace(class_logits=_judged(answers, given.hypothesis))
        yield chosen, prediction


def _judged(answers: list[Prediction], hypothesis: NDArray[np.int64]) -> Tensor:
    """(B,K) each class's logit from the answer under its own hypothesis."""
    logits = torch.stack([answer.class_logits for answer in answers])
    classes = torch.arange(logits.shape[2], device=logits.device)
    return logits[torch.from_numpy(hypothesis).to(logits.device), :, classes].T


def predict_rows(
    model: nn.Module,
    dataset: Clouds,
    rows: NDArray[np.int64],
    class_names: Sequence[str],
    device: torch.device | str = "cpu",
    batch_size: int = 32,
    train_sources: Sequence[str] = (),
    given: Told | None = None,
    answers_alone: bool = False,
) -> Predictions:
    """Predictions for ``rows`` of a test split.

    The clouds are scored in a fixed shuffled order, so that no batch is of one class.

    Args:
        class_names: of the model, which may have been trained on other classes than ``dataset``'s.
        train_sources: ``duplicates.source_keys`` of the training data.
        given: see ``run_model``; in the order of ``rows``.
        answers_alone: keep the answer and its confidence, and the best pose, as of a test under
            another condition than trained on.

    Raises:
        NotFiniteError: see there.
    """
    if len(rows) == 0:
        raise ValueError("there is nothing to evaluate: no rows")
    order = generator(0, "test order").permutation(len(rows))
    told = None if given is None else given._replace(rotations=given.rotations[order])
    known = _shared(class_names, dataset.class_names)
    parts: list[dict[str, Tensor]] = []
    answers = run_model(model, dataset, rows[order], len(class_names), device, batch_size, told)
    for _, prediction in answers:
        if not dataset.has_poses:  # nothing tells whether its poses are right
            prediction = prediction._replace(pose_logits=None)
        parts.append(_kept(prediction, known, answers_alone))
    back = np.argsort(order)
    kept = {name: torch.cat([part[name] for part in parts]).numpy()[back] for name in parts[0]}
    return Predictions(
        **vars(testsets.of(dataset, rows)),
        **kept,
        duplicate=duplicates.among(dataset.source_digests[rows], list(train_sources)),
    )


def _shared(model_classes: Sequence[str], test_classes: Sequence[str]) -> Tensor | None:
    """(K,) which of the model's classes the test data have too; None where they are the same."""
    if list(model_classes) == list(test_classes):
        return None
    return torch.tensor([name in test_classes for name in model_classes])


def _require_finite(prediction: Prediction, rows: NDArray[np.int64]) -> None:
    parts = [("class logits that are not finite", ~torch.isfinite(prediction.class_logits))]
    # −∞ is a pose that cannot be.
    if prediction.pose_logits is not None:
        parts.append(("pose logits that are NaN", prediction.pose_logits.isnan()))
    if prediction.candidates is not None:
        parts.append(("candidate logits that are NaN", prediction.candidates[0].isnan()))
    for what, wrong in parts:
        clouds = int(wrong.any(dim=1).sum())
        if clouds:
            raise NotFiniteError(
                f"{clouds} of {len(rows)} clouds (rows {rows.min()} to {rows.max()}) got {what}; "
                f"the model is broken or its weights are",
                what,
            )


def _kept(prediction: Prediction, shared: Tensor | None, answers_alone: bool) -> dict[str, Tensor]:
    """What ``Predictions`` has of a batch's answers."""
    logits = prediction.class_logits.double().cpu()
    logs, classes = logits.log_softmax(dim=1).sort(dim=1, descending=True, stable=True)
    nothing = torch.zeros((len(logits), 0))
    best_shared, bins, decided = nothing, nothing, nothing
    if shared is not None:
        first = shared[classes].to(torch.uint8).argmax(dim=1, keepdim=True)
        best_shared = classes.gather(1, first)
    if prediction.pose_logits is not None:
        bins = prediction.pose_logits.argsort(dim=1, descending=True, stable=True).cpu()
    if prediction.candidates is not None and not answers_alone:
        found = [part[:, :POSE_BINS_KEPT].cpu().numpy() for part in prediction.candidates]
        decided = torch.from_numpy(deciding_classes(*found))
    kept = 1 if answers_alone else CLASSES_KEPT
    return {
        "classes": classes[:, :kept].to(torch.int16),
        # float16 ends at −65504; beyond that a probability is zero anyway.
        "log_probabilities": logs[:, :kept].clamp(min=-60_000).to(torch.float16),
        "shared": best_shared.to(torch.int16),
        "pose_bins": bins[:, : 1 if answers_alone else POSE_BINS_KEPT].to(torch.uint8),
        "decided": decided.to(torch.int16),
    }


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
