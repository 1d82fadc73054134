"""Metrics against values worked out by hand and against scikit-learn and torchmetrics."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import sklearn.metrics
import torch
from scipy.spatial.transform import Rotation
from torchmetrics.functional.classification import multiclass_calibration_error

from partialbench.benchmark.records.predictions import Predictions, deciding_classes
from partialbench.benchmark.testing import metrics
from partialbench.geometry.bins import nearest_bins, rotation_bins
from partialbench.geometry.rotations import axis_rotation, haar_rotations
from partialbench.geometry.symmetry import GROUPS, map_rotation

CASES = {
    "random": (40, 7, None, None),
    "a class never predicted": (60, 5, None, 3),
    "a class absent from the test set": (60, 5, 2, None),
    "one sample": (1, 4, None, None),
    "one class": (10, 2, 1, 1),
}


def case(name):
    size, classes, absent, never = CASES[name]
    rng = np.random.default_rng(len(name))
    labels, predicted = rng.integers(0, classes, (2, size))
    if absent is not None:
        labels[labels == absent] = 0
    if never is not None:
        predicted[predicted == never] = 0
    return labels, predicted, classes


@pytest.mark.parametrize("name", CASES)
def test_accuracies_and_confusion_equal_scikit_learn(name):
    labels, predicted, classes = case(name)
    assert metrics.accuracy(labels, predicted) == pytest.approx(
        sklearn.metrics.accuracy_score(labels, predicted)
    )
    assert np.array_equal(
        metrics.confusion(labels, predicted, classes),
        sklearn.metrics.confusion_matrix(labels, predicted, labels=range(classes)),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns of predicted classes that are absent
        balanced = sklearn.metrics.balanced_accuracy_score(labels, predicted)
        recall = sklearn.metrics.recall_score(
            labels, predicted, labels=range(classes), average=None, zero_division=np.nan
        )
    assert metrics.class_accuracy(labels, predicted, classes) == pytest.approx(balanced)
    ours = [np.nan if v is None else v for v in
            metrics.per_class_accuracy(labels, predicted, classes)]  # fmt: skip
    assert ours == pytest.approx(recall.tolist(), nan_ok=True)


def test_accuracies_by_hand():
    labels, predicted = np.array([0, 0, 0, 1]), np.array([0, 0, 2, 1])
    assert metrics.accuracy(labels, predicted) == 0.75
    assert metrics.per_class_accuracy(labels, predicted, 3) == [2 / 3, 1.0, None]
    assert metrics.class_accuracy(labels, predicted, 3) == pytest.approx(5 / 6)


@pytest.mark.parametrize("size", [1, 3, 500])
def test_calibration_error_equals_torchmetrics(size):
    rng = np.random.default_rng(size)
    logits = torch.from_numpy(rng.standard_normal((size, 6)))
    labels = rng.integers(0, 6, size)
    confidence, predicted = logits.softmax(1).max(1)
    expected = multiclass_calibration_error(logits.softmax(1), torch.from_numpy(labels), 6, 15)
    ours = metrics.calibration_error(confidence.numpy(), predicted.numpy() == labels)
    assert ours == pytest.approx(float(expected), abs=1e-6)


def test_calibration_error_by_hand():
    # Bin (0.6, 0.667]: mean confidence 0.65, accuracy 0.5. Bin (0.933, 1]: 1 and 1.
    error = metrics.calibration_error(
        np.array([0.64, 0.66, 1.0, 1.0]), np.array([True, False, True, True])
    )
    assert error == pytest.approx(0.5 * 0.15)
    assert metrics.calibration_error(np.array([0.0]), np.array([False])) == 0.0
    with pytest.raises(ValueError, match=r"in \[0, 1\]"):
        metrics.calibration_error(np.array([1.2]), np.array([True]))


@pytest.mark.parametrize("function", [metrics.accuracy, metrics.calibration_error])
def test_nothing_to_score_is_an_error(function):
    with pytest.raises(ValueError, match="at least 1"):
        function(np.zeros(0), np.zeros(0))
    with pytest.raises(ValueError, match="one length"):
        function(np.zeros(3), np.zeros(4))


def test_a_label_outside_the_classes_is_an_error():
    with pytest.raises(ValueError, match=r"predicted must lie in \[0, 3\), got 0 to 3"):
        metrics.confusion(np.array([0, 1]), np.array([0, 3]), 3)


def make(labels, logits, pose_bins=None, rotations=None, symmetries=None, visible=None,
         decided=None, duplicate=None, shared=None):  # fmt: skip
    labels = np.asarray(labels, np.int16)
    m = len(labels)
    logs = torch.as_tensor(np.asarray(logits, float)).log_softmax(1).numpy()
    order = logs.argsort(1)[:, ::-1]
    return Predictions(
        class_names=np.array(["a", "b"]), classes=order.astype(np.int16),
        log_probabilities=np.take_along_axis(logs, order, 1).astype(np.float16),
        shared=np.zeros((m, 0), np.int16) if shared is None else np.asarray(shared, np.int16),
        rows=np.arange(m, dtype=np.int32), labels=labels,
        pose_bins=np.zeros((m, 0), np.uint8) if pose_bins is None else pose_bins,
        quaternions=Rotation.from_matrix(np.tile(np.eye(3), (m, 1, 1)) if rotations is None
                                         else rotations).as_quat().astype(np.float32),
        decided=np.zeros((m, 0), np.int16) if decided is None else decided,
        duplicate=np.zeros(m, bool) if duplicate is None else np.asarray(duplicate),
        symmetries=np.full(m, "none") if symmetries is None else np.asarray(symmetries),
        object_ids=np.array([f"o{i // 2}" for i in range(m)]), views=np.zeros(m, np.int32),
        visible_fraction=np.full(m, 0.3, np.float32) if visible is None else visible,
    )  # fmt: skip


def test_classes_are_matched_by_name_with_and_without_the_other_outputs():
    """Model: bed, chair, sofa. Test data: sofa, lamp, bed (lamp unknown to the model)."""
    labels = [0, 0, 1, 2]  # sofa, sofa, lamp, bed
    logits = [[0, 5, 4], [0, 1, 5], [9, 0, 0], [5, 0, 1]]  # says chair, sofa, bed, bed
    shared = [[2], [2], [0], [0]]  # sofa before bed, and so on
    scores = metrics.scores(
        make(labels, logits, shared=shared), ["bed", "chair", "sofa"], ["sofa", "lamp", "bed"]
    )
    assert scores["clouds"] == 3  # the lamp is left out
    assert scores["accuracy"] == pytest.approx(2 / 3)
    assert scores["restricted_accuracy"] == 1.0  # chair is not a class of the test data
    assert scores["per_class"] == {"bed": 1.0, "chair": None, "sofa": 0.5}
    assert scores["pose"] is None
    with pytest.raises(ValueError, match="no test cloud has a class the model knows"):
        metrics.scores(make(labels, logits), ["a", "b", "c"], ["sofa", "lamp", "bed"])


def test_equal_classes_make_restriction_idle(rng):
    logits = rng.standard_normal((50, 5))
    logits[:, 1] = logits[:, 0] + 1e-6  # a tie once rounded to float16
    p = make(rng.integers(0, 5, 50), logits)
    scores = metrics.scores(p, list("abcde"), list("abcde"))
    assert scores["accuracy"] == scores["restricted_accuracy"]
    assert scores["accuracy"] == metrics.accuracy(p.labels, p.predicted)


def test_the_loudest_of_the_first_k_poses_decides():
    logits = np.array([[1, 3, 2], [5, 4, 5], [0, 1, 9]], np.float32)
    classes = np.array([[0, 1, 0], [1, 0, 0], [2, 0, 1]], np.int16)
    # k = 1 says 0, 1, 2; k = 2 says 1, 1, 0; k = 3 says 1, 1 (the first of equals), 1.
    decided = deciding_classes(logits, classes)
    assert decided.tolist() == [[0, 1, 1], [1, 1, 1], [2, 0, 1]]
    assert metrics.ensemble_accuracy(decided, np.array([0, 1, 1])) == pytest.approx(
        [2 / 3, 1 / 3, 2 / 3]
    )
    assert metrics.ensemble_accuracy(decided[:, :0], np.zeros(3, int)) is None
    p = make([0, 1, 1], np.eye(3), decided=decided)
    # By name: the model's classes stand in another order than the data's.
    scores = metrics.scores(p, ["b", "a", "c"], ["a", "b", "c"])
    assert scores["ensemble"] == pytest.approx([0, 2 / 3, 1 / 3])


def test_duplicates_are_left_out_of_one_score():
    logits = [[9, 0], [9, 0], [9, 0], [0, 9]]
    p = make([0, 0, 1, 1], logits, duplicate=[True, False, False, False])
    scores = metrics.scores(p, ["a", "b"], ["a", "b"])
    assert scores["accuracy"] == 0.75
    assert scores["duplicates"] == 1
    assert scores["accuracy_without_duplicates"] == pytest.approx(2 / 3)
    assert scores["class_accuracy_without_duplicates"] == pytest.approx(3 / 4)
    scores = metrics.scores(make([0], [[9, 0]], duplicate=[True]), ["a", "b"], ["a", "b"])
    assert scores["accuracy_without_duplicates"] is None


def test_accuracy_by_visibility_puts_each_cloud_in_one_bin():
    correct = np.array([1, 0, 1, 1, 0], bool)
    rows = metrics.by_visibility(correct, np.array([0.0, 0.1, 0.19, 0.7, 1.0]))
    assert [r["clouds"] for r in rows] == [1, 2, 0, 0, 0, 0, 2]
    assert [r["accuracy"] for r in rows] == [1.0, 0.5, None, None, None, None, 0.5]


def test_pose_scores_of_an_oracle_and_of_its_opposite(rng):
    names = np.array(sorted(GROUPS))[rng.integers(0, len(GROUPS), 200)]
    R = haar_rotations(rng, 200)
    mapped = np.stack([map_rotation(r, GROUPS[n]) for r, n in zip(R, names, strict=True)])
    best = nearest_bins(mapped, 60)
    p = make(np.zeros(200), np.zeros((200, 2)), best[:, :20].astype(np.uint8), R, names)
    scores = metrics.pose_scores(p)
    assert scores["top_k"] == [1.0] * 20
    assert scores["mean_deg"] < 35
    assert max(scores["median_deg"], 0) < 44.5
    reverse = make(np.zeros(200), np.zeros((200, 2)), best[:, :39:-1].astype(np.uint8), R, names)
    assert metrics.pose_scores(reverse)["top_k"] == [0.0] * 20
    second = np.roll(best[:, :20], 1, axis=1).astype(np.uint8)
    shifted = metrics.pose_scores(make(np.zeros(200), np.zeros((200, 2)), second, R, names))
    assert shifted["top_k"][:2] == [0.0, 1.0]


def test_pose_errors_by_hand():
    """Errors of 0°, 20° and 90° for no symmetry; half a turn is nothing for z-180 and for z-inf."""
    R = np.stack([axis_rotation("x", np.radians(a)) for a in (0, 20, 90)] * 1)
    p = make([0, 0, 0], np.zeros((3, 2)), np.zeros((3, 1), np.uint8), R)
    scores = metrics.pose_scores(p)
    assert scores["mean_deg"] == pytest.approx(110 / 3, abs=1e-4)
    assert scores["median_deg"] == pytest.approx(20, abs=1e-4)
    assert scores["within_15"] == pytest.approx(1 / 3)
    assert scores["within_30"] == pytest.approx(2 / 3)

    half, third = axis_rotation("z", np.pi), axis_rotation("z", 2 * np.pi / 3)
    true = np.stack([half, half, half, third, third])
    names = np.array(["none", "z-180", "z-inf", "z-180", "z-inf"])
    errors = metrics.pose_errors_deg(np.tile(rotation_bins()[0], (5, 1, 1)), true, names)
    assert errors == pytest.approx([180, 0, 0, 60, 0], abs=1e-5)
