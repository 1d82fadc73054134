"""What breaks after the last epoch breaks before the first; one process works on a training."""

from __future__ import annotations

import json
import random
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn

from partialbench.benchmark import preflight
from partialbench.benchmark.fabric import make_fabric
from partialbench.benchmark.prediction import Prediction
from partialbench.benchmark.protocol.split import split_by_object
from partialbench.benchmark.records.trials import FILE, read_trials
from partialbench.benchmark.run import _say_odd_classes, run_eval
from partialbench.benchmark.training import seeds
from partialbench.benchmark.training.held import hold
from partialbench.benchmark.tune import tune
from partialbench.dataset.lock import NAME, InUseError
from partialbench.dataset.shards import write_atomically
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import MemoryClouds, data_folder
from tests.benchmark.tiny_models import MODELS, SMALL, NoNorm

HERE = __name__


class AloneFails(NoNorm):
    def __init__(self, num_classes: int) -> None:
        super().__init__(num_classes)
        self.norm = nn.BatchNorm1d(num_classes, track_running_stats=False)

    def forward(self, clouds):
        return self.norm(super().forward(clouds))


class Camera(NoNorm):
    def forward(self, clouds):
        return super().forward(torch.cat([clouds[..., :2], clouds[..., 2:].log()], -1))


class Pair(NoNorm):
    def forward(self, clouds):
        answer = super().forward(clouds)
        return answer if self.training else (answer, None)


class Grows(NoNorm):
    def forward(self, clouds):
        if not hasattr(self, "scale"):
            self.register_buffer("scale", clouds.std())
        return super().forward(clouds / self.scale)


class Lazy(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.layer = nn.LazyLinear(num_classes)

    def forward(self, clouds):
        return self.layer(clouds).amax(dim=1)


class Untrained(nn.Module):
    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.register_buffer("w", torch.randn(3, num_classes))

    def forward(self, clouds):
        return clouds.abs().mean(1) @ self.w


class PlainList(NoNorm):
    """Layers that are in no state_dict."""

    def __init__(self, num_classes: int) -> None:
        super().__init__(num_classes)
        self.more = [nn.Linear(num_classes, num_classes)]

    def forward(self, clouds):
        return self.more[0](super().forward(clouds))


class PlainTensor(NoNorm):
    """A running mean that is no buffer; of ``buffer`` one that is not saved."""

    def __init__(self, num_classes: int, buffer: bool = False) -> None:
        super().__init__(num_classes)
        if buffer:
            self.register_buffer("mean", torch.zeros(num_classes), persistent=False)
        else:
            self.mean = torch.zeros(num_classes)

    def forward(self, clouds):
        logits = super().forward(clouds)
        if self.training:
            self.mean = 0.5 * self.mean + 0.5 * torch.tensor([1.0, 0.0, -1.0])
        return logits + self.mean


class PoseNan(NoNorm):
    def forward(self, clouds):
        logits = super().forward(clouds)
        return Prediction(logits, logits.new_full((len(clouds), 60), float("nan")))


ONE = NoNorm(3)


def the_same(num_classes: int) -> nn.Module:
    return ONE


def shared_layer(num_classes: int) -> nn.Module:
    fresh = NoNorm(num_classes)
    fresh.head.weight = nn.Parameter(ONE.head.weight.data)
    return fresh


class LateDrift(NoNorm):
    """What it remembers of the training is in no state_dict, and shows after some steps only."""

    def __init__(self, num_classes: int) -> None:
        super().__init__(num_classes)
        self.steps = 0

    def forward(self, clouds):
        self.steps += self.training
        return super().forward(clouds) + (self.steps > 2) * torch.tensor([1.0, 0.0, -1.0])


class LateNan(LateDrift):
    """Trains without a fault and answers NaN, once it has trained a little."""

    def forward(self, clouds):
        logits = super().forward(clouds)
        return logits if self.training or self.steps < 3 else logits * torch.nan


class Drawn(NoNorm):
    """Initialised by the global generators of NumPy and Python."""

    def __init__(self, num_classes: int) -> None:
        super().__init__(num_classes)
        self.head.weight.data += torch.from_numpy(np.random.randn(64).astype(np.float32))  # noqa: NPY002
        self.head.bias.data += random.random()


@pytest.mark.parametrize(
    ("name", "message", "protocol"),
    [
        ("AloneFails", "one cloud alone fails: ValueError: Expected more than 1 value", {}),
        ("Camera", "turned about the camera gives class logits that are not finite",
         {"rotation": "none"}),
        ("Pair", "model returned a tuple", {}),
        ("Grows", "do not make it again: .*scale is float32", {}),
        ("Lazy", "layer.weight, layer.bias have no shape before a first forward pass", {}),
        ("Untrained", "no trainable parameters", {}),
        ("PlainList", "answers otherwise than the one that was trained", {}),
        ("PlainTensor", "answers otherwise than the one that was trained", {}),
        ("PlainTensor", "a buffer with persistent=False", {"options": {"buffer": True}}),
        ("PoseNan", "one cloud alone gives pose logits that are NaN", {}),
        ("the_same", r"two models that share \d of their parameters \(", {}),
        ("shared_layer", r"two models that share 1 of their parameters \(head.weight\)", {}),
    ],
)  # fmt: skip
def test_what_would_break_in_the_end_breaks_before_the_start(
    data, tmp_path, name, message, protocol
):
    with pytest.raises(InputError, match=message):
        run_eval(f"{HERE}:{name}", data, results_folder=tmp_path, **{**SMALL, **protocol})
    assert not list(tmp_path.rglob("checkpoint.pt"))
    assert not list(tmp_path.glob("*.predictions.npz"))


def test_a_model_whose_checkpoint_is_not_all_of_it_is_not_tested(data, tmp_path):
    given = SMALL | {"clouds": [320]}
    with pytest.raises(InputError, match=r"its class logits move by .* % of their size"):
        run_eval(f"{HERE}:LateDrift", data, results_folder=tmp_path, **given)
    assert list(tmp_path.rglob("checkpoint.pt"))
    assert not list(tmp_path.glob("*.predictions.npz"))


def test_a_model_that_draws_from_numpy_is_repeatable(data, tmp_path):
    np.random.seed(3)  # noqa: NPY002
    one = run_eval(f"{HERE}:Drawn", data, results_folder=tmp_path / "1", **SMALL)[0]
    np.random.seed(4)  # noqa: NPY002
    two = run_eval(f"{HERE}:Drawn", data, results_folder=tmp_path / "2", **SMALL)[0]
    assert one.predictions_sha256 == two.predictions_sha256


def test_what_is_drawn_in_a_dry_run_is_drawn_again():
    def draw():
        return random.random(), np.random.rand(), float(torch.rand(()))  # noqa: NPY002

    seeds.seed_all(5)
    expected = draw()
    seeds.seed_all(5)
    with seeds.kept():
        draw()
    assert draw() == expected


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"model": "pointnt"}, "did you mean pointnet"),
        ({"model": "./absent.py:make"}, "no file at absent.py"),
        ({"precision": "64-true"}, "expected 16-mixed, 32-true, bf16-mixed"),
        ({"precision": "bf16-true"}, "is not trained in"),
        ({"device": "cpu:1"}, "device cpu has no number, got 'cpu:1'"),
        ({"device": "gpu"}, "auto, cpu, cuda"),
        ({"device": "cuda:x"}, "auto, cpu, cuda"),
        ({"data": ["nowhere"]}, "nowhere"),
        ({"checkpoints": ["no.pt"]}, "no checkpoint at no.pt"),
    ],
)
def test_arguments_are_checked_first(given, message):
    with pytest.raises(InputError, match=message):
        preflight.check(**{"model": "pointnet", **given})


def test_a_folder_for_results_must_be_one(tmp_path):
    (tmp_path / "file").write_text("")
    for wrong in ("file", "file/under"):
        with pytest.raises(InputError, match=r"--results: .*file is not a folder"):
            preflight.check("pointnet", results=tmp_path / wrong)
    preflight.check("pointnet", results=tmp_path / "to" / "be" / "made")


def test_a_typo_is_answered_before_torch_is_imported():
    code = (
        "import sys\nfrom partialbench.cli import app\n"
        "try: app(['eval', '--model', 'typo', '--data', 'x'])\n"
        "except Exception as error: print(error, 'torch' in sys.modules)"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "no model named 'typo'" in ran.stdout, ran.stderr
    assert ran.stdout.endswith("False\n")


def test_one_process_holds_a_training(tmp_path):
    folder = tmp_path / "run"
    code = (
        "import sys, pathlib\nfrom partialbench.benchmark.training.held import hold\n"
        "with hold(pathlib.Path(sys.argv[1])):\n    print('held', flush=True)\n    sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    with (
        pytest.raises(
            InUseError, match=f"working on {folder} .process {other.pid} on .*; wait for it"
        ),
        hold(folder),
    ):
        pass
    other.kill()
    other.wait()
    with hold(folder):
        assert json.loads((folder / NAME).read_text())["pid"] != other.pid
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match=r"cannot use .*--results"),
        hold(tmp_path / "file" / "run"),
    ):
        pass


def test_temporary_names_are_each_writers_own(tmp_path, monkeypatch):
    import os

    seen = []
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (seen.append(a), replace(a, b)))
    for _ in range(3):
        write_atomically(tmp_path / "one", b"x")
    assert len(set(seen)) == 3


def test_objects_made_from_the_same_bytes_validate_together():
    ids = np.array([f"chair_{i:02d}" for i in range(20)])
    digests = np.array([f"{i // 2}" for i in range(20)])
    labels = np.zeros(20, int)
    for fraction, count in ((0.1, 2), (0.3, 6), (0.05, 2)):
        train, held = split_by_object(ids, labels, ["chair"], fraction, 0, digests)
        assert len(held) == count
        assert not set(digests[train]) & set(digests[held])
    every = np.full(20, "one")
    assert len(split_by_object(ids, labels, ["chair"], 0.1, 0, every)[1]) == 0
    unknown = np.full(20, "")
    alone = split_by_object(ids, labels, ["chair"], 0.1, 0, unknown)
    assert all(map(np.array_equal, alone, split_by_object(ids, labels, ["chair"], 0.1)))
    across = np.arange(20) // 10
    _, held = split_by_object(ids, across, ["a", "b"], 0.2, 0, np.tile(digests[:10], 2))
    assert len(held) == 0  # made from the same bytes as an object of another class


def test_a_diverged_trial_is_recorded_and_the_rest_goes_on(data, tmp_path):
    tries = [{"lr": 0.01}, {"lr": 1e30}, {"lr": 0.001}]
    for _ in range(2):
        found = tune(
            f"{MODELS}:NoNorm", data, tries, "smoke", device="cpu", results_folder=tmp_path,
            clouds=480, protocol={"num_points": 32, "max_train_clouds": None},
        )  # fmt: skip
        assert [trial.recipe for trial in found][-1] == "lr=1e+30"
        assert len({trial.clouds_seen for trial in found}) == 1  # of a diverged one, its goal
        assert [trial.diverged for trial in found] == [False, False, True]
        assert sorted(read_trials(tmp_path / FILE), key=repr) == sorted(found, key=repr)


def test_a_trial_whose_answers_are_nan_is_no_trial_of_class_nought(data, tmp_path):
    given = {"num_points": 32, "max_train_clouds": None}
    (trial,) = tune(
        f"{HERE}:LateNan", data, [{}], "smoke", device="cpu", results_folder=tmp_path, clouds=480,
        protocol=given,
    )  # fmt: skip
    assert trial.diverged


def test_nothing_to_validate_on_is_an_error_at_the_start(tmp_path):
    few = data_folder(tmp_path / "few", objects=3)
    with pytest.raises(InputError, match=r"no object is left to validate.*bottle 3, chair 3"):
        tune(f"{MODELS}:NoNorm", few, [{}], "smoke", device="cpu", results_folder=tmp_path / "r",
             protocol={"num_points": 32})  # fmt: skip
    assert not (tmp_path / "r").exists()


def test_a_class_that_only_one_split_has_is_told(tmp_path, caplog):
    """Nothing is wrong with such a table but that nobody can name these rightly."""
    classes = ("bottle", "chair", "lamp")
    train, test = MemoryClouds(classes=classes), MemoryClouds(classes=classes)
    train.folder, train.labels = "toy", np.minimum(train.labels, 1)
    test.labels = np.maximum(test.labels, 1)
    _say_odd_classes(train, test)
    assert [record.getMessage() for record in caplog.records] == [
        "toy: of lamp there are test objects but no training object: no model can name them "
        "rightly",
        "toy: of bottle there are training objects but no test object",
    ]
    caplog.clear()
    _say_odd_classes(test, test)
    assert caplog.records == []


def test_several_processes_look_for_what_the_loss_does_not_reach(monkeypatch):
    made = {}

    class Fabric:
        def __init__(self, **given):
            made.update(given)

        def launch(self):
            pass

    monkeypatch.setattr("partialbench.benchmark.fabric.Fabric", Fabric)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    monkeypatch.setenv("WORLD_SIZE", "2")
    make_fabric("cpu", "32-true")
    assert made["strategy"]._ddp_kwargs["find_unused_parameters"] is True
