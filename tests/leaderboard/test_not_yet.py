"""What campaigns ask for and is not there yet: told, never ranked, and no part of a check."""

import csv
import dataclasses
import json

import pytest

from leaderboard.board import make_board
from leaderboard.build import build_leaderboard
from leaderboard.check import problems
from leaderboard.tables.not_yet import absent, asked_rows, progress, sentence
from partialbench.benchmark.records import declared, results
from partialbench.benchmark.records.declared import Declared
from partialbench.errors import InputError
from tests.leaderboard.records import add, hash_of


@pytest.fixture
def folder(tmp_path):
    for seed in range(2):
        add(tmp_path, "good", 0.9, seed)
    add(tmp_path, "poor", 0.4)
    return tmp_path


def asks(folder, *rows):
    """Writes what a campaign asks for: (model, seed, state, reason, clouds)."""
    first = results.read_folder(folder)[0]
    made = [
        Declared(
            "shapes", "shapes", first.train_data.digest, first.test_data.digest, "board",
            first.protocol_digest, clouds, model, "", model.upper(), seed, state, reason,
        )
        for model, seed, state, reason, clouds in rows
    ]  # fmt: skip
    declared.write(folder / f"one{declared.SUFFIX}", made)
    return made


ASKED = (
    ("good", 0, "done", "", 100_000), ("good", 1, "done", "", 100_000),
    ("good", 2, "missing", "", 100_000), ("gone", 0, "done", "", 100_000),
    ("wild", 0, "failed", "the loss became nan", 100_000),
    ("late", 0, "waiting", "data set 'x' needs X", 100_000),
    ("good", 0, "missing", "", 200_000),
)  # fmt: skip


def test_what_was_written_is_read_again_and_in_any_order_the_same(folder):
    made = asks(folder, *ASKED)
    path = folder / f"one{declared.SUFFIX}"
    assert declared.read(path) == sorted(made)
    before = path.read_bytes()
    declared.write(path, reversed(made))
    assert path.read_bytes() == before
    # Of two campaigns that ask for one row, the one that knows more about it is heard.
    declared.write(
        folder / f"two{declared.SUFFIX}",
        [dataclasses.replace(each, state="missing", reason="") for each in made],
    )
    assert declared.read_folder(folder) == sorted(made)


def test_rows_that_are_not_there_are_told_with_their_reason(folder):
    asks(folder, *ASKED)
    board = make_board(results.read_folder(folder))
    asked = asked_rows(board[0], declared.read_folder(folder))
    assert {each.name: (each.seeds, each.there) for each in asked} == {
        "good": ((0, 1, 2), (0, 1)), "gone": ((0,), ()), "late": ((0,), ()), "wild": ((0,), ()),
    }  # fmt: skip
    # Said to be done, and yet without a record: not there.
    assert [(each.title, each.state) for each in absent(asked)] == [
        ("WILD", "failed: the loss became nan"), ("GONE", "not yet"),
        ("LATE", "waits: data set 'x' needs X"),
    ]  # fmt: skip
    assert sentence(asked) == (
        "Not yet: GONE. Failed: WILD (the loss became nan). Waits: LATE (data set 'x' needs X)."
    )
    (table,) = progress(board, declared.read_folder(folder))
    assert table.head == ["data", "100k clouds", "200k clouds"]
    assert table.rows == [["shapes, board", "2 of 6", "0 of 1"]]


def test_the_board_says_it_everywhere_and_a_check_does_not_ask(folder, tmp_path):
    build_leaderboard(folder, tmp_path / "before")
    wrong = problems(folder)  # of made-up models that no registry has
    asks(folder, *ASKED)
    assert problems(folder) == wrong
    page, *_ = build_leaderboard(folder, tmp_path / "out")
    assert "Not yet: GONE." in (tmp_path / "out" / "leaderboard.md").read_text()
    assert "2 of 6" in (tmp_path / "out" / "leaderboard.tex").read_text()
    lines = list(csv.DictReader((tmp_path / "out" / "not_yet.csv").read_text().splitlines()))
    assert len(lines) == 5
    assert {line["state"] for line in lines} == {"missing", "failed", "waiting"}
    data = json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])
    (column,) = data["columns"]
    assert column["asked"]["good"] == 3
    assert [each["id"] for each in column["absent"]] == ["wild", "gone", "late"]
    for name in ("leaderboard.csv", "differences.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "before" / name).read_bytes()
    assert not (tmp_path / "before" / "not_yet.csv").exists()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[]", "the whole: input should be a valid dict"),
        ('{"format": "partialbench-campaign", "format_version": 1, "data": {}, "protocols": {}, '
         '"rows": [{"train": "a", "test": "a", "protocol": "p", "clouds": 0, "model": "m", '
         '"variant": "", "title": "", "seeds": []}]}', "rows.0.clouds"),
        ('{"format": "partialbench-campaign", "format_version": 1, "data": {}, "protocols": {}, '
         '"rows": [{"train": "a", "test": "a", "protocol": "p", "clouds": 1, "model": "m", '
         '"variant": "", "title": "", "seeds": [{"seed": 0, "state": "done", "reason": ""}]}]}',
         "does not say what 'a' is"),
    ],
)  # fmt: skip
def test_a_file_that_no_campaign_wrote_is_refused_by_name(folder, text, told):
    path = folder / f"one{declared.SUFFIX}"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"one\.campaign\.json is not what a campaign.*{told}"):
        declared.read_folder(folder)


def test_the_digests_of_the_board_are_those_of_the_records(folder):
    # A row of other data is asked for elsewhere.
    asks(folder, ("gone", 0, "missing", "", 100_000))
    board = make_board(results.read_folder(folder))
    other = dataclasses.replace(declared.read_folder(folder)[0], train_digest=hash_of("other"))
    assert asked_rows(board[0], [other]) == []
