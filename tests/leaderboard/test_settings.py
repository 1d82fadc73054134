"""What is lost from one setting to the next, from records made up for it."""

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.tables.settings import as_layout, losses, setting_families
from partialbench.benchmark.records import results
from partialbench.benchmark.testing.uncertainty import bootstrap_intervals
from tests.leaderboard.records import add


def add_setting(folder, name, setting, accuracy, **other):
    return add(folder, name, accuracy, setting=setting, digest=setting[0], **other)


def layouts(folder):
    families = setting_families(make_board(results.read_folder(folder)))
    return [as_layout(family, losses(family, folder)) for family in families]


def test_the_loss_is_the_difference_of_accuracies_with_its_paired_interval(tmp_path):
    for setting, accuracy in (("partial", 0.3), ("aligned", 0.9), ("rotated", 0.5)):
        for seed in range(2):
            add_setting(tmp_path, "one", setting, accuracy, seed=seed, views=1)
    add_setting(tmp_path, "partial-only", "partial", 0.9, views=1)
    (table,) = layouts(tmp_path)
    assert table.head == [
        "model", "aligned", "rotated", "partial", "aligned − rotated", "rotated − partial",
    ]  # fmt: skip
    assert table.title == "By setting: pm40-parametric, board, 100k clouds"
    ((title, *accuracies, first, _),) = table.rows
    assert title == "ONE"
    records = [r for r in results.read_folder(tmp_path) if r.model == "one"]
    right, ids = {}, np.array([])
    for setting in ("aligned", "rotated"):
        stored = [
            results.read_predictions(tmp_path, r)
            for r in records
            if r.test_data.setting == setting
        ]  # fmt: skip
        ids = stored[0].object_ids
        right[setting] = np.mean([p.predicted == p.labels for p in stored], axis=0)
    assert accuracies[0].startswith(f"{100 * right['aligned'].mean():.1f} ± ")
    lost = (right["aligned"] - right["rotated"])[:, None]
    mean, low, high = (
        float(x) for x in first.replace("(", "").replace(")", "").split(" ") if x != "–"
    )
    assert mean == pytest.approx(100 * lost.mean(), abs=0.051)
    assert (low, high) == pytest.approx(100 * bootstrap_intervals(lost, ids)[0], abs=0.051)


def test_settings_with_unequal_numbers_of_views_are_paired_by_object(tmp_path):
    add_setting(tmp_path, "one", "rotated", 0.9, views=1)
    add_setting(tmp_path, "one", "partial", 0.5, views=3)
    (table,) = layouts(tmp_path)
    before, after = (float(text) for text in table.rows[0][1:3])
    # Every object here has as many views as any other, so the two means are one.
    assert float(table.rows[0][3].split()[0]) == pytest.approx(before - after, abs=0.11)


def test_one_setting_another_protocol_or_no_row_in_common_make_no_table(tmp_path):
    add_setting(tmp_path, "one", "partial", 0.9)
    assert layouts(tmp_path) == []
    add_setting(tmp_path, "two", "rotated", 0.9)
    add_setting(tmp_path, "one", "aligned", 0.9, preset="paper")
    assert setting_families(make_board(results.read_folder(tmp_path))) == []
    assert layouts(tmp_path) == []


def test_each_number_of_training_clouds_is_compared_with_its_own(tmp_path):
    for name in ("one", "two"):
        add_setting(tmp_path, name, "aligned", 0.9, clouds=100)
        add_setting(tmp_path, name, "rotated", 0.7, clouds=100)
        add_setting(tmp_path, name, "partial", 0.5, clouds=300)
    add(tmp_path, "one", 0.95, setting="rotated", digest="R", clouds=300)
    small, large = setting_families(make_board(results.read_folder(tmp_path)))
    assert [c.training_clouds for c in small.values()] == [100, 100, 300]
    assert [c.training_clouds for c in large.values()] == [100, 300, 300]
    assert (
        small["rotated"].title
        == "pm40-parametric, rotated, board, 100k clouds (100 training clouds)"
    )
    assert small["partial"].title == "pm40-parametric, partial, board, 100k clouds"
    first, second = layouts(tmp_path)
    assert [row[0] for row in first.rows] == ["ONE", "TWO"]
    assert [row[0] for row in second.rows] == ["ONE", "TWO"]
    two = second.rows[1]
    assert (two[2], two[4], two[5]) == ("–", "–", "–")  # not trained on so many rotated clouds
    assert "–" not in (two[1], two[3])
    assert first.about.endswith("Training clouds: 100 aligned, 100 rotated, 300 partial.")
    assert second.about.endswith("Training clouds: 100 aligned, 300 rotated, 300 partial.")
    assert second.title == "By setting: pm40-parametric, board, 100k clouds"


def test_of_columns_that_differ_in_digests_alone_the_fullest_is_compared(tmp_path):
    add_setting(tmp_path, "one", "rotated", 0.9)
    add(tmp_path, "one", 0.5, setting="partial", digest="p")
    for name in ("one", "two"):
        add(tmp_path, name, 0.6, setting="partial", digest="z")
    add(tmp_path, "one", 0.5, setting="partial", digest="a")
    (family,) = setting_families(make_board(results.read_folder(tmp_path)))
    assert sorted(family["partial"].cells) == ["one", "two"]
