"""What the page says, as data: ranks, sentences, commands, learning curves."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import math
import re
import shutil

import numpy as np
import pytest

from leaderboard import scaling
from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.comparison import compare
from leaderboard.page import clouds, facts, html, rows
from leaderboard.page.command import reproduce
from leaderboard.page.content import Found, content, kind
from partialbench.benchmark.protocol.protocol import protocol
from partialbench.benchmark.records import results
from partialbench.errors import InputError
from tests.leaderboard.records import CLASSES, add, predictions, record, small_board


def data_of(path):
    text = path.read_text(encoding="utf-8")
    return json.loads(
        re.search(r'<script type="application/json" id="data">(.*?)</script>', text)[1]
    )


def column_of(folder):
    (column,) = make_board(results.read_folder(folder))
    return column


def test_equal_ranks_cannot_be_told_apart(tmp_path):
    for name, accuracy in (("good", 0.95), ("even", 0.94), ("poor", 0.4), ("worst", 0.1)):
        add(tmp_path, name, accuracy, views=1, objects=200)
    column = column_of(tmp_path)
    comparison = compare(column, tmp_path)
    found = {row["id"]: row for row in rows.rows_of(column, comparison, tmp_path)}
    assert {name: row["rank"] for name, row in found.items()} == {
        "good": 1, "even": 1, "poor": 3, "worst": 4,
    }  # fmt: skip
    first = max(("good", "even"), key=lambda name: column.cells[name].mean())
    assert found[first]["behind"] is None
    ahead = column.cells[first].mean() - column.cells["poor"].mean()
    assert found["poor"]["behind"][0] == pytest.approx(ahead, abs=1e-3)
    assert found["poor"]["behind"][1] < ahead < found["poor"]["behind"][2]


def test_a_model_is_shown_as_declared_and_not_by_its_best_variant(tmp_path):
    add(tmp_path, "one", 0.6)
    add(tmp_path, "one", 0.9, options={"k": 5})
    add(tmp_path, "two", 0.5, options={"k": 5})
    add(tmp_path, "two", 0.8, options={"k": 7})
    column = column_of(tmp_path)
    assert set(rows.main_rows(column)) == {"one", "two [k=7]"}
    found = rows.rows_of(column, compare(column, tmp_path), tmp_path)
    (better,) = (row for row in found if row["id"] == "one [k=5]")
    assert better["rank"] is None
    assert better["behind"][0] < 0  # ahead of the first line, and said to be


def test_the_command_makes_the_row_again():
    stored = predictions(0.9, 0)
    changed = protocol("board", num_points=512)
    made = record(
        "my model:make", stored, seed=3, options={"grid": 16},
        variant="grid=16; recipe lr=0.002; precision bf16-mixed", test="ps15-rooms",
    )  # fmt: skip
    made = dataclasses.replace(made, protocol=changed.as_dict(), protocol_digest=changed.digest)
    assert reproduce((made,)) == (
        "partialbench eval --model 'my model:make' --data data/pm40-parametric "
        "--test-data data/ps15-rooms --preset board --protocol num_points=512 --clouds 100k "
        "--option grid=16 --recipe lr=0.002 --precision bf16-mixed --first-seed 3"
    )
    two = tuple(dataclasses.replace(record("pointnet", stored), seed=seed) for seed in (0, 1))
    assert reproduce(two) == (
        "partialbench eval --model pointnet --data data/pm40-parametric --preset board "
        "--clouds 100k --seeds 2"
    )


def test_the_command_names_the_row_s_seeds_its_two_settings_and_its_own_recipe():
    stored = predictions(0.9, 0)
    first = record("pointnet", stored)
    seeds = tuple(dataclasses.replace(first, seed=seed) for seed in (0, 1, 4, 7, 8))
    start = "partialbench eval --model pointnet --data data/pm40-parametric --preset board"
    assert reproduce(seeds).splitlines() == [
        f"{start} --clouds 100k{run}"
        for run in (" --seeds 2", " --first-seed 4", " --seeds 2 --first-seed 7")
    ]
    # Trained on complete clouds, tested on partial ones of the same data set.
    whole = dataclasses.replace(first.train_data, setting="rotated")
    assert reproduce((dataclasses.replace(first, train_data=whole),)) == (
        "partialbench eval --model pointnet --data data/pm40-parametric-rotated --test-data "
        "data/pm40-parametric-partial --preset board --clouds 100k"
    )
    options = {"f": "a; recipe lr=1; precision x"}
    (written,) = (f"{name}={json.dumps(value)}" for name, value in options.items())
    made = record("pointnet", stored, options=options, variant=f"{written}; recipe lr=0.002")
    assert reproduce((made,)) == f"{start} --clouds 100k --option '{written}' --recipe lr=0.002"


def test_a_training_is_told_of_one_seed_and_its_log_at_the_clouds_it_was_written(tmp_path):
    stored = predictions(0.7, 0)
    for seed, seconds in ((3, 600.0), (4, 60.0)):
        made = record("one", stored, seed)
        clouds = made.training["clouds_seen"]
        training = {
            **made.training, "seconds": seconds, "clouds_per_second": clouds / seconds,
            "curve": {"clouds_seen": [8 * clouds // 10, 9 * clouds // 10, clouds],
                      "train_loss": [2.0, 1.0, 0.5], "validation_accuracy": [None, None, 0.7]},
        }  # fmt: skip
        results.write(tmp_path, dataclasses.replace(made, training=training), stored)
    column = column_of(tmp_path)
    (row,) = rows.rows_of(column, compare(column, tmp_path), tmp_path)
    told, log = row["more"]["training"], row["more"]["log"]
    assert (told["seed"], told["minutes"], told["seeds"]) == (3, 10, [3, 4])
    assert told["per_second"] == pytest.approx(told["clouds"] / 60 / told["minutes"], rel=0.01)
    assert row["minutes"] == told["minutes"]
    assert [[c / told["clouds"], v] for c, v in log["training loss"]] == [
        [pytest.approx(0.8), 2.0], [pytest.approx(0.9), 1.0], [1.0, 0.5],
    ]  # fmt: skip
    assert log["validation accuracy"] == []
    # An older record says nothing of clouds: its lines are the ends of its epochs.
    old = {"clouds_seen": 100, "curve": {"train_loss": [3.0, 2.0, 1.0, 0.5]}}
    assert rows._log(old, "train_loss") == [[25, 3.0], [50, 2.0], [75, 1.0], [100, 0.5]]


def test_a_power_law_is_found_again_and_told_with_its_interval():
    clouds = (25_000, 50_000, 100_000, 200_000)
    exact = [scaling.Seen(n, 1 - 3 * n**-0.25, 0, 0) for n in clouds]
    found = scaling.extrapolate(exact)
    assert found.exponent == pytest.approx(0.25)
    assert found.accuracy == pytest.approx(1 - 3 * 1e6**-0.25)
    assert found.high - found.low < 1e-6
    noisy = [p._replace(accuracy=p.accuracy + off) for p, off in
             zip(exact, (0.01, -0.01, 0.01, -0.01), strict=True)]  # fmt: skip
    wide = scaling.extrapolate(noisy)
    assert wide.low < wide.accuracy < wide.high
    assert wide.high - wide.low > 0.02
    # Nothing is said of three milestones, of a row without error, or where the row itself is.
    assert scaling.extrapolate(exact[:3]) is None
    assert scaling.extrapolate([*exact[:3], exact[3]._replace(accuracy=1.0)]) is None
    assert scaling.extrapolate(exact, clouds=200_000) is None


def test_confusions_and_reliability_count_every_cloud(tmp_path):
    add(tmp_path, "one", 0.7, seed=0)
    add(tmp_path, "one", 0.7, seed=1)
    column = column_of(tmp_path)
    (row,) = rows.rows_of(column, compare(column, tmp_path), tmp_path)
    cell, more = column.cells["one"], row["more"]
    assert sum(count for *_, count in more["reliability"]) == 2 * 120
    right = sum(share * count for _, share, count in more["reliability"]) / 240
    assert right == pytest.approx(cell.mean(), abs=1e-3)
    wrong = np.zeros(4)
    for true, _, share in more["confusions"]:
        wrong[true] += share
    shares = dict(more["per_class"])
    classes = cell.results[0].train_data.class_names
    assert [shares[name] for name in classes] == pytest.approx(1 - wrong, abs=2e-3)


def test_the_sentences_say_who_is_best_what_is_lost_and_what_the_pose_is_worth(tmp_path):
    for setting, accuracy in (("aligned", 0.98), ("rotated", 0.8), ("partial", 0.6)):
        add(tmp_path, "good", accuracy, setting=setting, digest=setting, posed=True, objects=100)
        add(tmp_path, "poor", accuracy - 0.5, setting=setting, digest=setting, objects=100)
    add(tmp_path, "good", 0.9, digest="partial", posed=True, given_pose="0", objects=100)
    (page, *_) = build_leaderboard(tmp_path, tmp_path / "out")
    data = data_of(page)
    (column,) = (c for c in data["columns"] if c["kind"] == "partial")
    best, lost, pose = column["facts"]
    row = next(r for r in column["rows"] if r["id"] == "good")
    assert best.startswith(f"GOOD names {100 * row['accuracy']:.1f} % (")
    assert "more than the next, POOR." in best
    assert lost.startswith("After 100k clouds GOOD reaches ")
    assert "on complete clouds in a known pose" in lost
    assert "are lost from rotated to partial" in lost
    assert pose.startswith("The best pose is GOOD's: the right one of 60 bins for ")
    assert "told the true pose, GOOD gains " in pose


def test_boards_of_one_record_and_of_none_make_sense(tmp_path):
    add(tmp_path, "only", 0.7)
    (page, *_) = build_leaderboard(tmp_path, tmp_path / "out")
    (column,) = data_of(page)["columns"]
    assert column["facts"][0].endswith("it is the only model tested here.")
    assert column["rows"][0]["rank"] == 1
    empty = content(Found([], [], [], [], [], [], [], [], [], []), tmp_path)
    assert empty["columns"] == []
    assert "Add a row" in html.render(empty)


def test_what_runs_on_the_page_is_allowed_by_digest_and_nothing_else_is(tmp_path):
    page = html.render({"columns": [], "note": "</script><script>alert(1)</script>"})
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    assert "unsafe" not in policy
    assert "default-src &#39;none&#39;" in policy
    for element in ("style", "script"):
        (text,) = re.findall(rf"<{element}>(.*?)</{element}>", page, re.S)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{element}-src &#39;sha256-{digest}&#39;" in policy
    assert "alert(1)" in page
    assert page.count("<script") == 2
    assert " style=" not in page


def test_a_column_is_on_the_tab_of_what_it_tests(tmp_path):
    small_board(tmp_path)
    add(tmp_path, "good", 0.9, setting="aligned", digest="e")
    board = make_board(results.read_folder(tmp_path))
    assert sorted(map(kind, board)) == ["complete", "partial", "transfer"]


def test_of_data_at_hand_the_cameras_are_used_and_clouds_shown_only_of_built_in_shapes(
    built, tmp_path, monkeypatch
):
    results_of = built.parents[1] / "results"

    def solids(**look):
        (page, *_) = build_leaderboard(results_of, tmp_path / "out", **look)
        (column,) = (c for c in data_of(page)["columns"] if c["group"].startswith("solids"))
        places = {v["quantity"] for v in column["views"]} - {"visible fraction"}
        return places, len(column["samples"])

    cameras = {"distance", "elevation"}
    assert solids() == (cameras, 0)  # the data folder lies beside the records
    shutil.copytree(built.parents[1] / "data", tmp_path / "elsewhere" / "solids")
    shutil.copytree(results_of, tmp_path / "records")
    results_of = tmp_path / "records"
    assert solids() == (set(), 0)
    assert solids(look_in=[tmp_path / "elsewhere"]) == (cameras, 0)
    with pytest.raises(InputError, match=r"no folder to look for data in at .*nowhere"):
        solids(look_in=[tmp_path / "nowhere"])
    monkeypatch.setattr(clouds, "LICENCE_CLEAN", ("solids",))
    assert solids(look_in=[tmp_path / "elsewhere"])[1] > 0


def test_what_accuracy_costs_is_one_sentence(tmp_path):
    for name, accuracy in (("best", 0.9), ("lighter", 0.8), ("it", 0.3)):
        add(tmp_path, name, accuracy, objects=100)
    column = column_of(tmp_path)
    found = rows.rows_of(column, compare(column, tmp_path), tmp_path)
    (told,) = facts.cost(found)
    assert told.startswith("BEST, the most accurate, takes 4.0 M multiply-adds a cloud; ")
    assert "the cheapest, IT, 2.0 M multiply-adds at " in told
    assert told.endswith("Of the 2 others 1 cost more than the first.")
    assert facts.cost(found[:2]) == [
        "BEST, the most accurate, takes 4.0 M multiply-adds a cloud; LIGHTER 7.0 M multiply-adds."
    ]
    (told,) = facts.cost([found[0], found[2]])
    assert told.endswith("; the cheapest, IT, 2.0 M multiply-adds at 31.0 %.")
    assert facts.cost(found[:1]) == []


def test_milestones_of_a_row_are_one_curve(tmp_path):
    for milestone, accuracy in ((25_000, 0.5), (50_000, 0.6), (100_000, 0.7), (200_000, 0.75)):
        add(tmp_path, "one", accuracy, milestone=milestone, objects=100)
    (page, *_) = build_leaderboard(tmp_path, tmp_path / "out")
    data = data_of(page)
    assert len(data["columns"]) == 4
    ((curves),) = data["curves"].values()
    assert [p[0] for p in curves["one"]["points"]] == [25_000, 50_000, 100_000, 200_000]
    assert len({c["title"] for c in data["columns"]}) == 1
    far = curves["one"]["far"]
    assert far[1] < far[0] < far[2]
    assert not any(map(math.isnan, far))


def test_no_figure_that_is_printed_is_rounded_before(tmp_path):
    """48 of 173 are 27.7 %: rounded to 27.75 first, they would be 27.8."""
    stored = predictions(1.0, 0, objects=173, views=1)
    wrong = np.arange(173) >= 48
    stored.classes[wrong, :2] = stored.classes[wrong, 1::-1]
    results.write(tmp_path, record("one", stored), stored)
    (page, *_) = build_leaderboard(tmp_path, tmp_path / "out")
    ((row,),) = (column["rows"] for column in data_of(page)["columns"])
    assert row["accuracy"] == 48 / 173
    assert "names 27.7 % (" in data_of(page)["columns"][0]["facts"][0]
    assert "| 27.7 |" in (tmp_path / "out" / "leaderboard.md").read_text()
    classes = dict(row["more"]["per_class"])
    right = {name: sum(~wrong[i::4]) / len(wrong[i::4]) for i, name in enumerate(CLASSES)}
    assert {name: f"{100 * share:.1f}" for name, share in classes.items()} == {
        name: f"{100 * share:.1f}" for name, share in right.items()
    }
