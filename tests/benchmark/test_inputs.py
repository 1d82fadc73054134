"""Models that take normals: given those of the points, turned alike, refused data without."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
import torch
from torch import nn

from partialbench import registry
from partialbench.benchmark import inputs
from partialbench.benchmark.prediction import Batch
from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import audit, evaluate
from partialbench.benchmark.training.batches import BatchStream, Place
from partialbench.benchmark.training.loop import WithLoss
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import MemoryClouds, data_folder


class CloudsWithNormals(MemoryClouds):
    """A point's normal is here the direction to it from (0, 0, 3), which tells whose it is."""

    def __init__(self, **options):
        super().__init__(**options)
        self.has_normals = True

    def points_and_normals(self, indices, rng=None, distinct=False):
        points = self.points(indices, rng, distinct)
        return points, unit(points - np.float32((0, 0, 3)))


class Recorder(nn.Module):
    """Keeps what it was called with."""

    needs_normals = True

    def __init__(self, classes: int = 3) -> None:
        super().__init__()
        self.layer = nn.Linear(6, classes)
        self.calls: list[tuple[torch.Tensor, torch.Tensor]] = []

    def forward(self, points, normals):
        self.calls.append((points, normals))
        return self.layer(torch.cat([points, normals], dim=-1)).mean(dim=1)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def stream(normals: bool) -> BatchStream:
    clouds = CloudsWithNormals()
    return BatchStream(clouds, np.arange(len(clouds)), PRESETS["paper"], 8, seed=1, normals=normals)


def test_a_batch_has_the_normals_of_its_points_turned_with_them() -> None:
    plain, full = (s.make(Place(0, 1), s.order(0)) for s in (stream(False), stream(True)))
    assert plain.normals is None
    assert full.normals is not None
    torch.testing.assert_close(plain.points, full.points)
    # The rotation takes (0, 0, 3) along; from there the jittered points lie where normals point.
    dataset = CloudsWithNormals()
    rows = stream(True).order(0)[8:16]
    turn = full.rotation.numpy() @ dataset.rotations[rows].swapaxes(1, 2)
    centre = turn @ np.array([0, 0, 3.0])
    offset = full.points.numpy() - centre[:, None]
    agreement = (unit(offset) * full.normals.numpy()).sum(axis=-1)
    assert agreement.min() > 0.9
    assert agreement.mean() > 0.995


def test_models_are_called_with_them_in_training_testing_and_audit() -> None:
    dataset, model = CloudsWithNormals(), Recorder()
    s = stream(True)
    WithLoss(model, 0.0, 3)(s.make(Place(0, 0), s.order(0)))
    list(evaluate.run_model(model, dataset, np.arange(4), 3))
    audit.rotation_audit(model, dataset, 3, clouds=4, turns=1)
    audit.cost(model, dataset, batch_size=4)
    assert len(model.calls) > 5
    for points, normals in model.calls:
        assert normals.shape == points.shape
        torch.testing.assert_close(normals.norm(dim=-1), torch.ones(normals.shape[:2]))
    before, after = (normals for _, normals in model.calls[2:4])
    assert not torch.allclose(before, after), "the audit turns normals too"


def test_data_without_normals_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="the data set toy was made without; render it with"):
        inputs.of_rows(Recorder(), MemoryClouds(), np.arange(2))
    points, more = inputs.of_rows(nn.Linear(3, 3), MemoryClouds(), np.arange(2))
    assert points.shape == (2, 64, 3)
    assert not more
    folder = data_folder(tmp_path / "data", points=256)
    with pytest.raises(InputError, match="riconv2-normals takes normals, and the data set"):
        run_eval("riconv2-normals", folder, preset="smoke", results_folder=tmp_path / "results")


def test_a_batch_without_normals_is_as_ever() -> None:
    batch = Batch(*(torch.zeros(1) for _ in range(4)))
    assert batch.normals is None


def test_where_nobody_knows_the_poses_none_is_learnt() -> None:
    clouds = MemoryClouds()
    clouds.has_poses = False
    rows = np.arange(len(clouds))
    s = BatchStream(clouds, rows, PRESETS["paper"], 8, seed=1)
    batch = s.make(Place(0, 0), s.order(0))
    assert batch.rotation.isnan().all()
    assert batch.mapped_rotation.isnan().all()
    clouds.has_poses = True
    known = BatchStream(clouds, rows, PRESETS["paper"], 8, seed=1)
    torch.testing.assert_close(batch.points, known.make(Place(0, 0), known.order(0)).points)
    assert WithLoss(registry.create("pointnet", 3), 0.0, 3)(batch).isfinite()


@pytest.mark.parametrize(
    ("name", "options", "learns"),
    [
        ("papnet-steered", {}, True),
        ("papnet-steered", {"pose_weight": 0.0}, False),
        ("papnet-steered-nopose", {}, False),
        ("papnet", {"grid": 16}, True),
        ("papnet", {"grid": 16, "variant": "without-pose"}, False),
        ("pointnet", {}, False),
    ],
)
def test_models_that_learn_poses_are_refused_data_without(name, options, learns) -> None:
    clouds, model = MemoryClouds(), registry.create(name, 3, **options)
    inputs.require_poses(clouds, model, name)
    clouds.has_poses = False
    expected = pytest.raises(InputError, match=f"{name} learns poses, and nobody knows those")
    with expected if learns else contextlib.nullcontext():
        inputs.require_poses(clouds, model, name)
