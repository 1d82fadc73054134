"""Effects of a factorial study on made-up records whose answer is known."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from scipy import stats

from leaderboard.effects import analyse, as_layouts, level, select
from partialbench.benchmark.protocol.protocol import protocol
from partialbench.benchmark.records import results
from partialbench.benchmark.testing import metrics
from partialbench.benchmark.testing.uncertainty import contrast
from partialbench.errors import InputError
from tests.leaderboard.records import CLASSES, predictions, record

FACTORS = ("pose_weight", "ray", "stretch")
WORTH = {"pose_weight": 0.10, "ray": 0.05, "stretch": 0.0}
BOTH = 0.06
"""What pose and ray together are worth beside."""


def answers(accuracy: float, cell: int, seed: int):
    """The first ``accuracy`` of the clouds right, in an order of the seed's own."""
    stored = predictions(1.0, seed=100 * cell + seed, objects=100, views=2)
    order = np.random.default_rng([cell, seed]).permutation(len(stored))
    wrong = order[round(accuracy * len(stored)) :]
    classes = stored.classes.copy()
    classes[wrong] = classes[wrong][:, [1, 0, 2, 3]]
    return dataclasses.replace(stored, classes=classes)


def add_cell(folder, at, seed, accuracy, cell=0):
    pose, ray, stretch = at
    options = {**({} if pose else {"pose_weight": 0.0}), **({"ray": True} if ray else {})}
    stored = answers(accuracy, cell, seed)
    followed = protocol("board", stretch=1.25 if stretch else 1.0)
    variant = " ".join(f"{k}={v}" for k, v in sorted(options.items()))
    made = record("papnet-steered", stored, seed, options=options, variant=variant)
    made = dataclasses.replace(
        made, protocol=followed.as_dict(), protocol_digest=followed.digest,
        scores=metrics.scores(stored, CLASSES, CLASSES),
    )  # fmt: skip
    results.write(folder, made, stored)


def true_accuracy(at) -> float:
    pose, ray, _ = at
    return 0.5 + WORTH["pose_weight"] * pose + WORTH["ray"] * ray + BOTH * pose * ray


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("study")
    for cell, at in enumerate(itertools.product((0, 1), repeat=3)):
        for seed, off in enumerate((-0.01, 0.0, 0.01)):
            add_cell(made, at, seed, true_accuracy(at) + off, cell)
    return made


def chosen(folder, **where):
    return select(
        results.read_folder(folder), ["papnet-steered"], "pm40-parametric", "pm40-parametric",
        100_000, where,
    )  # fmt: skip


def test_effects_are_those_that_were_made(folder):
    study = analyse(chosen(folder), folder, FACTORS)
    assert study.factors == {
        "pose_weight": (0.0, 0.3), "ray": (False, True), "stretch": (1.0, 1.25),
    }  # fmt: skip
    assert study.accuracy[(0.0, False, 1.0)] == pytest.approx([0.49, 0.5, 0.51])
    found = {names: effect.value for names, effect in study.effects.items()}
    assert found == pytest.approx(
        {
            ("pose_weight",): 0.10 + BOTH / 2, ("ray",): 0.05 + BOTH / 2, ("stretch",): 0.0,
            ("pose_weight", "ray"): BOTH, ("pose_weight", "stretch"): 0.0, ("ray", "stretch"): 0.0,
        },
        abs=1e-9,
    )  # fmt: skip
    pose = study.effects[("pose_weight",)]
    # Seeds of a cell vary by 1 point; an effect is a difference of two means of 12 trainings.
    assert pose.seeds == pytest.approx(0.01 * (2 / 12) ** 0.5)
    assert pose.low < 0.13 < pose.high
    assert pose.p_value < 0.01
    assert study.effects[("stretch",)].low < 0 < study.effects[("stretch",)].high
    cells, effects = as_layouts(study)
    assert cells.rows[0] == ["0.0", "False", "1.0", "50.0 ± 1.0"]
    assert effects.rows[0][0] == "pose_weight 0.0 → 0.3"
    assert effects.rows[0][1].startswith("13.0 (")


def test_a_part_of_the_study_can_be_asked_about(folder):
    study = analyse(chosen(folder, stretch=1.25), folder, ("pose_weight", "ray"))
    assert len(study.accuracy) == 4
    assert study.effects[("ray",)].value == pytest.approx(0.05 + BOTH / 2, abs=1e-9)


def test_what_would_not_be_a_comparison_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match="ray=False has several records of one seed"):
        analyse(chosen(folder), folder, ("pose_weight", "ray"))
    with pytest.raises(InputError, match=r"width has the levels \['128'\]"):
        analyse(chosen(folder), folder, ("width",))
    with pytest.raises(InputError, match="papnet-steered has no option 'rays'"):
        level(chosen(folder)[0], "rays")
    for at, seed in (((0, 0, 0), 0), ((1, 1, 0), 0)):
        add_cell(tmp_path, at, seed, 0.5)
    with pytest.raises(InputError, match=r"no records of pose_weight=0.0, ray=True; pose_weight=0"):
        analyse(chosen(tmp_path), tmp_path, ("pose_weight", "ray"))
    with pytest.raises(InputError, match=r"differ in more than|each cell has one seed"):
        analyse(chosen(tmp_path), tmp_path, ("pose_weight",))


def test_an_interval_that_includes_seeds_holds_the_truth_as_often_as_it_says():
    """Two methods of two trainings each, equally good; trainings and objects both vary."""
    rng, held, narrow = np.random.default_rng(0), 0, 0
    trials, objects = 400, 60
    ids = np.repeat(np.arange(objects), 2)
    for _ in range(trials):
        hard = rng.normal(0, 0.2, objects)[:, None, None]
        of_seed = rng.normal(0, 0.03, (2, 3))
        values = 0.5 + hard + of_seed + rng.normal(0, 0.2, (objects, 2, 3))
        per_cloud = np.repeat(values, 2, axis=0)
        found = contrast(
            per_cloud.mean(2), ids, [list(per_cloud[:, row].mean(0)) for row in (0, 1)], [1, -1]
        )
        held += found.low <= 0 <= found.high
        reach = stats.norm.ppf(0.975) * found.objects
        narrow += abs(found.value) <= reach
    assert 0.93 < held / trials <= 1
    assert narrow / trials < held / trials - 0.05, "objects alone are too sure"


def test_a_contrast_is_arithmetic():
    values = np.array([[1.0, 0.0], [1.0, 0.5], [0.0, 0.0], [1.0, 1.0]])
    found = contrast(values, np.arange(4), [[0.70, 0.80], [0.35, 0.40]], [1, -1])
    assert found.value == pytest.approx(0.375)
    residuals = np.array([1.0, 0.5, 0.0, 0.0]) - 0.375
    assert found.objects == pytest.approx((residuals @ residuals / 3 / 4) ** 0.5)
    pooled = (0.005 + 0.00125) / 2  # sums of squares of two seeds about their means
    assert found.seeds == pytest.approx((pooled * 2 / 2) ** 0.5)
    with pytest.raises(ValueError, match="a row with two seeds"):
        contrast(values, np.arange(4), [[0.7], [0.4]], [1, -1])
