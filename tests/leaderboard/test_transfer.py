"""Transfer on equal terms, on made-up answers whose shares are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.tables.transfer import find_transfers, transfer_layouts
from partialbench.benchmark.records import results
from partialbench.benchmark.records.predictions import Predictions
from partialbench.benchmark.testing import metrics
from tests.leaderboard.records import CLASSES, predictions, record

SHARED = ["chair", "table"]
OBJECTS = 80


def answers(shares: dict[str, float], across: bool, mix: dict[str, int] | None = None):
    """Clouds of which each class has its share right, to within one cloud."""
    stored = predictions(1.0, seed=1, objects=OBJECTS, views=2)
    names = np.array(CLASSES)[stored.labels]
    classes = stored.classes.copy()
    for name, share in shares.items():
        rows = np.flatnonzero(names == name)
        wrong = rows[round(share * len(rows)) :]
        label = CLASSES.index(name)
        others = [c for c in range(4) if c != label]
        classes[wrong] = [others[0], label, *others[1:]]
    stored = dataclasses.replace(stored, classes=classes)
    keep = np.zeros(len(stored), bool)
    for name in CLASSES:
        rows = np.flatnonzero(names == name)
        keep[rows[: (mix or {}).get(name, len(rows))]] = True
    stored = stored.select(keep)
    if not across:
        return stored
    stored = stored.select(np.isin(np.array(CLASSES)[stored.labels], SHARED))
    labels = np.array([SHARED.index(CLASSES[label]) for label in stored.labels], np.int16)
    is_shared = np.isin(np.array(CLASSES)[stored.classes], SHARED)
    best = np.take_along_axis(stored.classes, is_shared.argmax(1)[:, None], axis=1)
    return Predictions(
        **{**{f.name: getattr(stored, f.name) for f in dataclasses.fields(Predictions)},
           "labels": labels, "shared": best, "class_names": np.array(SHARED)}
    )  # fmt: skip


def add(folder, name, within, across, seed=0, mix=None):
    for shares, other in ((within, False), (across, True)):
        stored = answers(shares, other, None if other else mix)
        where = {"test": "ps15-rooms", "test_digest": "c"} if other else {}
        if other:
            # ``record`` scores by its own classes; across data sets they are the shared ones.
            made = record(name, answers(within, False), seed, **where)
            test = dataclasses.replace(
                made.test_data, class_names=SHARED, clouds=len(stored),
                objects=len(np.unique(stored.object_ids)),
            )  # fmt: skip
            made = dataclasses.replace(
                made, test_data=test, scores=metrics.scores(stored, CLASSES, SHARED)
            )
        else:
            made = record(name, stored, seed)
        results.write(folder, made, stored)


def test_both_sides_have_the_shared_classes_in_one_mix(tmp_path):
    # Bottles and lamps are easy and not shared; within there are four times as many tables.
    mix = {"chair": 10, "table": 40, "bottle": 40, "lamp": 40}
    easy = {"bottle": 1.0, "lamp": 1.0}
    add(tmp_path, "posed", {**easy, "chair": 0.9, "table": 0.5},
            {"chair": 0.8, "table": 0.4}, mix=mix)  # fmt: skip
    add(tmp_path, "twin", {**easy, "chair": 0.6, "table": 0.5},
            {"chair": 0.4, "table": 0.3}, mix=mix)  # fmt: skip
    board = make_board(results.read_folder(tmp_path))
    (transfer,) = find_transfers(board, tmp_path)
    assert transfer.classes == ("chair", "table")
    posed, twin = (transfer.rows[name] for name in ("posed", "twin"))
    # The first 10 of 40 chair clouds within are all right: the share is by class, not by cloud.
    assert posed.within[0] == pytest.approx((1.0 + 0.5) / 2)
    assert twin.within[0] == pytest.approx((1.0 + 0.5) / 2)
    assert posed.across[0] == pytest.approx((0.8 + 0.4) / 2)
    assert twin.across[0] == pytest.approx((0.4 + 0.3) / 2)
    assert posed.drop[0] == pytest.approx(0.75 - 0.6)
    gain = transfer.gains["posed"]
    assert gain.within[0] == pytest.approx(0)
    assert gain.across[0] == pytest.approx(0.25)
    assert gain.drop[0] == pytest.approx(0.25)
    for mean, low, high in (*posed, *gain):
        assert low <= mean <= high
    assert posed.across[1] < posed.across[2]
    (layout,) = transfer_layouts(board, tmp_path)
    assert "2 classes of both test sets" in layout.about
    assert [row[0] for row in layout.rows] == ["POSED", "TWIN"]
    assert layout.rows[1][4:] == ["–"] * 3
    assert layout.rows[0][2].startswith("60.0 (")


def test_without_its_own_column_there_is_nothing_to_compare(tmp_path):
    add(tmp_path, "one", {"chair": 0.9}, {"chair": 0.8})
    board = make_board(results.read_folder(tmp_path))
    across = [column for column in board if column.key[0] != column.key[3]]
    assert find_transfers(across, tmp_path) == []
    assert len(find_transfers(board, tmp_path)) == 1


def test_only_seeds_that_were_tested_on_both_sides_count(tmp_path):
    for seed in (0, 1):
        add(tmp_path, "one", {"chair": 0.8, "table": 0.8}, {"chair": 0.5, "table": 0.5}, seed)
    first = find_transfers(make_board(results.read_folder(tmp_path)), tmp_path)
    own = [r for r in results.read_folder(tmp_path) if r.test_data.id != "ps15-rooms"]
    (tmp_path / f"{own[1].run_name}{results.SUFFIX}").unlink()
    after = find_transfers(make_board(results.read_folder(tmp_path)), tmp_path)
    assert first[0].rows["one"].within == after[0].rows["one"].within
    (column,) = [c for c in make_board(results.read_folder(tmp_path)) if "→" in c.title]
    assert column.cells["one"].seeds == 2
