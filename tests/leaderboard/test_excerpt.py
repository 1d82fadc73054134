"""Tables of the board shown in another document."""

from __future__ import annotations

import pytest

from leaderboard.excerpt import fill
from partialbench.errors import InputError

BOARD = """# Board

## toy, partial, mini

Trained on something.

| model | input | accuracy |
| --- | --- | --- |
| A [k=5] | pc | 60.0 |
| A [k=5; recipe lr=0.002] | pc | 55.0 |
| B | pc | 50.0 |

## toy, aligned, mini

| model | accuracy |
| --- | --- |
| A | 90.0 |
"""
DOCUMENT = """Before.
<!-- leaderboard: toy, partial, mini -->
| accuracy | model |
| stale |
<!-- end -->
Between.
<!-- leaderboard: toy, aligned, mini -->
| model |
<!-- end -->
"""


def test_the_header_chooses_the_columns_and_the_board_gives_the_rows():
    made = fill(DOCUMENT, BOARD)
    assert (
        made
        == """Before.
<!-- leaderboard: toy, partial, mini -->
| accuracy | model |
| --- | --- |
| 60.0 | A [k=5] |
| 55.0 | A [k=5; recipe lr=0.002] |
| 50.0 | B |
<!-- end -->
Between.
<!-- leaderboard: toy, aligned, mini -->
| model |
| --- |
| A |
<!-- end -->
"""
    )
    assert fill(made, BOARD) == made


def test_rows_by_a_recipe_of_their_own_are_left_out_where_that_is_asked():
    asked = DOCUMENT.replace("toy, partial, mini", "toy, partial, mini; without recipe")
    made = fill(asked, BOARD)
    assert "| 60.0 | A [k=5] |" in made
    assert "55.0" not in made
    assert fill(made, BOARD) == made


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("toy, partial, mini", "toy, rotated, mini", "no section 'toy, rotated, mini'"),
        ("| accuracy |", "| speed |", "no column 'speed', but model, input, accuracy"),
    ],
)
def test_what_the_board_does_not_have_is_named(old, new, message):
    with pytest.raises(InputError, match=message):
        fill(DOCUMENT.replace(old, new), BOARD)
