"""A cloud's score is its own: not its batch-mates', not what a test drew or changed before."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from leaderboard.build import build_leaderboard
from partialbench.benchmark.records import predictions as prediction_files
from partialbench.benchmark.records.results import INDEPENDENT
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.testing import audit, evaluate
from partialbench.benchmark.testing.company import company_audit
from partialbench.benchmark.testing.isolation import keyed_draws, unchanged
from partialbench.errors import InputError
from tests.benchmark import odd_models
from tests.benchmark.memory_clouds import MemoryClouds
from tests.benchmark.tiny_models import Bare


def made(kind, seed=0):
    torch.manual_seed(seed)
    return kind(3).eval()


@pytest.mark.parametrize("kind", [odd_models.WithPrior, odd_models.Batchwise,
                                  odd_models.ByBatchSize, odd_models.Adapting])  # fmt: skip
def test_an_answer_that_hangs_on_batch_mates_is_found(kind):
    assert company_audit(made(kind), MemoryClouds(), 3)["drift"] > 10 * INDEPENDENT


@pytest.mark.parametrize("objects", [1, 20])
@pytest.mark.parametrize("kind", [Bare, odd_models.InPlace, odd_models.Counting,
                                  odd_models.Remembering, odd_models.Hooked])  # fmt: skip
def test_an_answer_of_its_own_moves_by_rounding_alone(kind, objects):
    found = company_audit(made(kind), MemoryClouds(objects=objects, views=1), 3)
    assert found["drift"] < INDEPENDENT / 100
    assert found["changed_buffers"] == []
    assert not found["random"]


def test_a_model_that_draws_is_told_from_one_that_looks_at_others():
    found = company_audit(made(odd_models.Drawing), MemoryClouds(), 3)
    assert found["random"]
    assert found["drift"] < INDEPENDENT / 100


def test_what_a_test_changes_is_named():
    assert company_audit(made(odd_models.Adapting), MemoryClouds(), 3)["changed_buffers"] == [
        "centre"
    ]


def test_an_audited_answer_that_is_not_finite_says_where():
    class Alone(Bare):
        def forward(self, clouds):
            logits = super().forward(clouds)
            return logits if len(clouds) > 1 else logits * float("nan")

    with pytest.raises(InputError, match="scored alone got class logits that are not finite"):
        company_audit(made(Alone), MemoryClouds(), 3)


STATEFUL = [odd_models.Drawing, odd_models.Adapting, odd_models.Counting, odd_models.WithPrior,
            odd_models.Remembering, odd_models.OwnGenerator, odd_models.Hooked]  # fmt: skip


@pytest.mark.parametrize("kind", STATEFUL)
def test_testing_twice_or_something_in_between_gives_the_same_bytes(kind):
    model, clouds = made(kind), MemoryClouds()
    rows = np.arange(len(clouds))

    def test():
        return prediction_files.to_bytes(
            evaluate.predict_rows(model, clouds, rows, clouds.class_names)
        )

    first = test()
    evaluate.predict_rows(model, MemoryClouds(num_points=16), rows[:7], clouds.class_names)
    torch.rand(3), np.random.rand(3), random.random()  # noqa: NPY002
    assert test() == first


@pytest.mark.parametrize("kind", [odd_models.Counting, odd_models.Remembering])
def test_a_batch_does_not_see_the_batches_before_it(kind):
    clouds, model = MemoryClouds(), made(kind)
    rows = np.arange(len(clouds))
    alone, after = (
        torch.cat(
            [
                answer.class_logits
                for _, answer in evaluate.run_model(model, clouds, rows, 3, batch_size=size)
            ]
        )
        for size in (len(rows), 8)
    )
    assert torch.allclose(alone, after, atol=1e-5)


def test_what_shares_an_object_goes_on_sharing_it():
    model = made(odd_models.Hooked)
    with unchanged(model):
        model(torch.zeros(2, 8, 3))
    assert model.same[0] is model.watched
    with torch.no_grad():
        model.watched.bias.fill_(100.0)
    assert model(torch.zeros(2, 8, 3)).mean().item() > 90  # the hook is still this model's
    memory = made(odd_models.Remembering)
    with unchanged(memory):
        memory(torch.zeros(2, 8, 3))
    assert memory.bank is memory.writer.bank
    assert memory.bank == []
    buffer = made(odd_models.Adapting).centre
    model.register_buffer("centre", buffer)
    with unchanged(model):
        model.centre = torch.ones(3)
    assert model.centre is buffer


def test_the_order_of_the_rows_is_not_that_of_the_test():
    """By class, as data sets have them, a batch would give its mates away."""
    seen = []

    class Watching(Bare):
        def forward(self, clouds):
            seen.append(clouds.clone())
            return super().forward(clouds)

    clouds = MemoryClouds()
    stored = evaluate.predict_rows(made(Watching), clouds, np.arange(120), clouds.class_names)
    ordered = torch.from_numpy(clouds.points(np.arange(120)))
    assert not torch.equal(torch.cat(seen), ordered)
    alone = [int(made(Bare)(cloud[None]).argmax()) for cloud in ordered]
    assert stored.predicted.tolist() == alone  # and yet each answer stands in its row


def test_an_input_changed_in_place_is_no_other_models_input():
    clouds = MemoryClouds()
    here, there = (
        audit.rotation_audit(made(kind), clouds, 3)
        for kind in (odd_models.InPlace, odd_models.Centred)
    )
    assert here["drift"] == pytest.approx(there["drift"], abs=1e-6)


def test_a_model_is_put_back_to_the_bit():
    model = made(odd_models.Adapting)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    weight = next(model.parameters())
    with unchanged(model) as changed:
        model(torch.zeros(2, 8, 3))
        weight.data += 1
        model.register_buffer("memory", torch.ones(2))
        model.note = "new"
    name = next(iter(dict(model.named_parameters())))
    assert changed == sorted(["centre", "memory", name])
    assert all(torch.equal(model.state_dict()[name], before[name]) for name in before)
    assert next(model.parameters()) is weight  # what an optimiser holds
    assert model.calls == []
    assert not hasattr(model, "memory")
    assert not hasattr(model, "note")


def test_keyed_draws_leave_the_generators_where_they_were():
    def draw():
        return torch.rand(1).item(), np.random.rand(), random.random()  # noqa: NPY002

    torch.manual_seed(1), np.random.seed(1), random.seed(1)  # noqa: NPY002
    expected = draw()
    torch.manual_seed(1), np.random.seed(1), random.seed(1)  # noqa: NPY002
    with keyed_draws("a", 1):
        one = draw()
    with keyed_draws("a", 1):
        assert draw() == one
    with keyed_draws("a", 2):
        assert draw() != one
    assert draw() == expected


def test_a_row_that_looks_at_batch_mates_stands_apart(data, tmp_path, caplog):
    options = {"preset": "smoke", "device": "cpu", "num_points": 64, "max_test_clouds": None}
    for kind in ("WithPrior", "Centred"):
        (result,) = run_eval(
            f"tests.benchmark.odd_models:{kind}", data, results_folder=tmp_path / "r", **options
        )
        assert result.conditions == ({"scored": "transductively"} if kind == "WithPrior" else {})
    assert "depend on the clouds that are scored beside one" in caplog.text
    build_leaderboard(tmp_path / "r", tmp_path / "b", check=True)
    text = (tmp_path / "b" / "leaderboard.md").read_text()
    ranked, apart = text.split("## Answers that are not a cloud's own")
    assert "WithPrior" not in ranked
    assert "WithPrior" in apart
    assert "Centred" in ranked
