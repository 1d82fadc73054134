"""The table of damaged clouds, from records made up for it."""

import numpy as np
import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.tables.curves import find_families
from leaderboard.tables.damages import as_layout, find_damages, harmless_kinds, mean_errors
from partialbench.benchmark.records import results
from partialbench.benchmark.testing.damage import MODELNET_C, STRENGTHS, parse
from partialbench.errors import InputError
from tests.leaderboard.records import add


def found(folder):
    records = results.read_folder(folder)
    board = make_board(records)
    return board, find_damages(board, records, folder)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The reference and a better row under all of ModelNet-C's damages, a third under a few."""
    folder = tmp_path_factory.mktemp("records")
    for name, clean, loss in (("dgcnn", 0.9, 0.1), ("good", 0.9, 0.03), ("some", 0.5, 0.05)):
        add(folder, name, clean)
        for text in parse(MODELNET_C if name != "some" else ["jitter", "scale:1"]):
            strength = int(text[-1])
            add(folder, name, clean - loss * strength, damage=text)
    return folder


def test_damage_makes_no_column_and_no_curve(folder):
    board, (damages,) = found(folder)
    assert len(board) == 1
    assert find_families(board, results.read_folder(folder), folder) == []
    assert damages.column is board[0]
    assert set(damages.rows) == {"dgcnn", "good", "some"}


def test_the_reference_is_100_and_the_others_are_held_against_it(folder):
    _, (damages,) = found(folder)
    mce, rmce = damages.errors("dgcnn")
    assert mce == rmce == (1.0, 1.0, 1.0)
    records = {(r.model, r.damage): r.scores["accuracy"] for r in results.read_folder(folder)}
    ratios = {"mce": [], "rmce": []}
    for kind in MODELNET_C:
        wrong, lost = (
            [
                sum(top - records[model, f"{kind}:{s}"] for s in STRENGTHS)
                for model, top in (
                    (m, 1.0 if of == "mce" else records[m, ""]) for m in ("good", "dgcnn")
                )
            ]
            for of in ("mce", "rmce")
        )
        ratios["mce"].append(wrong[0] / wrong[1])
        ratios["rmce"].append(lost[0] / lost[1])
    mce, rmce = damages.errors("good")
    assert mce[0] == pytest.approx(np.mean(ratios["mce"]))
    assert rmce[0] == pytest.approx(np.mean(ratios["rmce"]))
    assert mce[1] < mce[0] < mce[2] < 1
    assert rmce[1] < rmce[0] < rmce[2]
    assert damages.errors("some") is None


def test_the_table_averages_over_strengths(folder):
    _, (damages,) = found(folder)
    layout = as_layout(damages)
    assert layout.head == ["model", "clean", "mCE", "RmCE", *MODELNET_C]
    lines = {row[0]: row for row in layout.rows}
    accuracies = [
        r.scores["accuracy"]
        for r in results.read_folder(folder)
        if r.model == "some" and r.damage.startswith("jitter")
    ]
    assert lines["SOME"][2:4] == ["–", "–"]
    assert lines["SOME"][4] == "–"  # scale in one strength only
    assert lines["SOME"][5] == f"{100 * np.mean(accuracies):.1f}"
    assert lines["DGCNN"][2] == "100.0 (100 – 100)"


def test_a_reference_that_loses_nothing_gives_no_ratio():
    right = {name: np.array([1.0, 0.0, 1.0]) for name in ("", *parse(MODELNET_C))}
    mce, rmce = mean_errors(right, right, np.array(["a", "b", "c"]))
    assert mce[0] == 1
    assert np.isnan(rmce).all()


def test_a_kind_that_the_reference_does_not_lose_under_is_left_out_of_what_is_lost():
    """Its ratio is one of two noises."""
    objects = np.array([f"o{k}" for k in range(200)])
    clean = np.arange(200) % 4 > 0

    def row(lost):
        found = {"": clean.astype(float)}
        for name in parse(MODELNET_C):
            some = np.arange(200) % 10 < lost
            harmless = name.startswith("rotate-about-view")
            found[name] = (clean & ~(some & (not harmless))).astype(float)
        return found

    reference, other = row(4), row(2)
    assert harmless_kinds(reference, objects) == ("rotate-about-view",)
    mce, rmce = mean_errors(other, reference, objects)
    ratios = [(clean & (np.arange(200) % 10 < lost)).sum() for lost in (2, 4)]
    assert rmce[0] == pytest.approx(ratios[0] / ratios[1])
    assert rmce[1] < rmce[0] < rmce[2]
    assert mce[0] < 1


def test_two_conditions_at_once_compare_with_no_row(tmp_path):
    add(tmp_path, "dgcnn", 0.9)
    add(tmp_path, "dgcnn", 0.8, damage="jitter:1", points=64)
    assert found(tmp_path)[1] == []


def test_a_board_shows_them_and_refuses_what_is_no_damage(tmp_path):
    add(tmp_path, "dgcnn", 0.9)
    add(tmp_path, "dgcnn", 0.8, damage="jitter:1")
    out = tmp_path / "board"
    build_leaderboard(tmp_path, out)
    assert "## Damaged clouds: pm40-parametric" in (out / "leaderboard.md").read_text()
    add(tmp_path, "dgcnn", 0.7, damage="rust:1")
    with pytest.raises(InputError, match="no damage named 'rust'"):
        build_leaderboard(tmp_path, out)
