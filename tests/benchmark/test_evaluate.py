"""Predictions, the rotation audit and cost of a model."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from partialbench import registry
from partialbench.benchmark.testing import audit, evaluate, metrics
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import Bare, Posed


def test_predictions_do_not_depend_on_the_batch_size():
    torch.manual_seed(0)
    model, clouds = Bare(3), MemoryClouds()
    rows = np.arange(50)
    a = evaluate.predict_rows(model, clouds, rows, clouds.class_names, batch_size=7)
    b = evaluate.predict_rows(model, clouds, rows, clouds.class_names, batch_size=50)
    assert np.array_equal(a.predicted, b.predicted)
    assert np.allclose(a.log_probabilities, b.log_probabilities, atol=2e-3)
    assert np.allclose(a.rotations, clouds.rotations[rows], atol=1e-6)
    assert np.allclose(np.exp(a.log_probabilities.astype(float)).sum(1), 1, atol=2e-3)


@pytest.mark.parametrize("variant", ["ground-truth", "predicted", "without-pose"])
def test_what_is_stored_gives_the_score_of_every_ensemble(variant):
    """Against PAPNet itself, made anew with each k."""
    clouds, rows = MemoryClouds(objects=4, views=1), np.arange(12)

    def papnet(k):
        torch.manual_seed(0)
        model = registry.create("papnet", 3, variant=variant, k=k, grid=16).eval()
        model.k = 1
        with torch.no_grad():  # fresh weights name one class always; so far as it is the same, off
            logits = model(torch.from_numpy(clouds.points(rows))).class_logits
            model.class_head.fc[-1].bias -= logits.mean(0)
        model.k = k
        return model

    stored = evaluate.predict_rows(papnet(20), clouds, rows, clouds.class_names)
    labels = stored.labels.astype(int)
    by_k = metrics.ensemble_accuracy(stored.decided, labels)
    if variant != "ground-truth":  # which decide by one pose, or by none
        assert by_k is None
        return
    assert stored.decided.shape == (12, 20)
    assert by_k[19] == metrics.accuracy(labels, stored.predicted)
    assert len(set(by_k)) > 1
    seven = evaluate.predict_rows(papnet(7), clouds, rows, clouds.class_names)
    assert seven.decided.shape == (12, 7)
    assert by_k[6] == metrics.accuracy(labels, seven.predicted)
    assert np.array_equal(seven.predicted, stored.decided[:, 6])


def test_candidates_of_another_shape_are_refused():
    class Wrong(Posed):
        def forward(self, clouds):
            shape = len(clouds), 20
            said = torch.zeros(shape), torch.zeros(len(clouds), 19)
            return super().forward(clouds)._replace(candidates=said)

    clouds = MemoryClouds()
    with pytest.raises(InputError, match=r"classes have shape \(8, 19\), expected \(8, 20\) for 8"):
        evaluate.predict_rows(Wrong(3), clouds, np.arange(8), clouds.class_names)


def test_a_model_that_answers_nan_is_refused():
    class Nan(Bare):
        def forward(self, clouds):
            logits = super().forward(clouds)
            logits[1, 0] = float("nan")
            return logits

    clouds = MemoryClouds()
    with pytest.raises(evaluate.NotFiniteError, match=r"1 of 8 clouds \(rows 0 to 7\)"):
        evaluate.predict_rows(Nan(3), clouds, np.arange(8), clouds.class_names)


@pytest.mark.parametrize("field", ["pose_logits", "candidates"])
def test_poses_that_are_nan_are_refused(field):
    class Nan(Posed):
        def forward(self, clouds):
            answer = super().forward(clouds)
            wrong = answer.pose_logits.where(torch.arange(60) > 0, torch.nan)
            return answer._replace(
                **{field: wrong if field == "pose_logits" else (wrong, wrong.argsort(1))}
            )

    clouds = MemoryClouds()
    with pytest.raises(evaluate.NotFiniteError, match=r"8 of 8 clouds .* logits that are NaN"):
        evaluate.predict_rows(Nan(3), clouds, np.arange(8), clouds.class_names)


def test_a_pose_that_cannot_be_may_be_minus_infinity():
    class Masked(Posed):
        def forward(self, clouds):
            answer = super().forward(clouds)
            possible = torch.arange(60) == 7
            return answer._replace(pose_logits=answer.pose_logits.where(possible, -torch.inf))

    clouds = MemoryClouds()
    said = evaluate.predict_rows(Masked(3), clouds, np.arange(8), clouds.class_names)
    assert (said.pose_bins[:, 0] == 7).all()


def test_the_rotation_audit_tells_an_invariant_model_from_one_that_is_not():
    class Radii(torch.nn.Module):
        def forward(self, clouds):
            centred = clouds - clouds.mean(1, keepdim=True)
            return centred.norm(dim=2).sort(dim=1).values[:, ::16]

    clouds = MemoryClouds()
    still = audit.rotation_audit(Radii(), clouds, 4)
    assert still["drift"] < 1e-5
    assert still["changed"] == 0
    torch.manual_seed(0)
    assert audit.rotation_audit(Bare(3), clouds, 3)["drift"] > 0.05


def test_cost_counts_the_multiply_adds_of_a_known_network():
    class Known(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.a, self.b = torch.nn.Linear(3, 8), torch.nn.Linear(8, 5)

        def forward(self, clouds):
            return self.b(self.a(clouds).amax(1))

    cost = audit.cost(Known(), MemoryClouds(num_points=64))
    assert cost["multiply_adds"] == 64 * 3 * 8 + 8 * 5
    assert cost["parameters"] == 3 * 8 + 8 + 8 * 5 + 5
    assert cost["latency_ms"] > 0
    assert cost["peak_memory_bytes"] > 2**20
