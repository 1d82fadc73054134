"""PAPNet with the published weights gives the published numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.steerable.published import field_from_published, field_to_published
from papnet.parts import uniform
from papnet.rotate_field import rotate_field
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins
from partialbench.registry import load_published


def load(shared: Path, classes: int):
    fixture = np.load(shared / "parity" / f"papnet_{classes}.npz")
    return fixture, {k.removeprefix("state/"): fixture[k] for k in fixture if "state/" in k}


@pytest.mark.parametrize("classes", [40, 15])
def test_logits_and_candidates(shared: Path, classes: int) -> None:
    fixture, state = load(shared, classes)
    model = load_published("papnet", state, classes)
    points = torch.as_tensor(fixture["points"])
    R = torch.as_tensor(fixture["given_rotation"])
    with torch.no_grad():
        given = model(points, rotation=R)
        inverse = model(points, rotation=R.transpose(1, 2)).class_logits
        model.k = 5
        own = model(points)
    expected = fixture["class_logits_given_rotation"]
    # The random weights spread the logits little, so the tolerance is tighter than the usual 1e-4.
    assert np.abs(given.class_logits.numpy() - expected).max() < 2e-6
    assert np.abs(inverse.numpy() - expected).max() > 1e-4
    assert np.abs(given.pose_logits.numpy() - fixture["pose_logits"]).max() < 2e-6
    logits, classes = own.candidates
    assert np.abs(logits.numpy() - fixture["candidate_logits"]).max() < 2e-6
    assert np.array_equal(classes.numpy(), fixture["candidate_classes"])
    best = logits.argmax(1, keepdim=True)
    assert torch.equal(own.class_logits.argmax(1), classes.gather(1, best)[:, 0])


def test_bins_are_in_the_released_order(shared: Path) -> None:
    fixture, _ = load(shared, 40)
    assert np.abs(rotation_bins() - fixture["rotation_bins"]).max() < 1e-6


@pytest.mark.parametrize("classes", [40, 15])
def test_field_rotation(shared: Path, classes: int) -> None:
    fixture, _ = load(shared, classes)
    fields = uniform(4)
    field = field_from_published(torch.as_tensor(fixture["field"]), fields)
    R = torch.as_tensor(fixture["given_rotation"])
    turned = field_to_published(rotate_field(field, R, fields), fields).numpy()
    assert np.abs(turned - fixture["field_rotated"]).max() < 1e-5
    back = field_to_published(rotate_field(field, R.transpose(1, 2), fields), fields).numpy()
    assert np.abs(back - fixture["field_rotated"]).max() > 0.1


def test_checkpoints_of_data_parallel_are_read_and_wrong_ones_refused(shared: Path) -> None:
    _, state = load(shared, 15)
    wrapped = {f"module.{name}": value for name, value in state.items()}
    a, b = (load_published("papnet", s, 15).state_dict() for s in (state, wrapped))
    assert all(torch.equal(a[name], b[name]) for name in a)
    with pytest.raises(InputError, match=r"fc3_c\.weight.*another number of classes"):
        load_published("papnet", state, 40)
    with pytest.raises(InputError, match=r"conv42\.conv\.running_var"):
        load_published(
            "papnet", {k: v for k, v in state.items() if k != "conv42.conv.running_var"}, 15
        )
