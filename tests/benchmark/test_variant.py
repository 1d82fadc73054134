"""Options have types, options and recipe two namespaces, and no two changes one name."""

from __future__ import annotations

import itertools
from typing import Literal

import pytest
import typer

from partialbench import arguments
from partialbench.benchmark.variant import describe_changes, file_name
from partialbench.errors import InputError
from partialbench.options import as_called, plain, typed, without_defaults


def factory(
    k, wide=True, momentum=0.1, kind="max", depth: int = 3, sizes=(1, 2),
    how: Literal["a", "b"] = "a", limit: float | None = None, note: str | None = None, **more,
):  # fmt: skip
    return k


@pytest.mark.parametrize(
    ("option", "given", "stored"),
    [
        ("wide", "False", False), ("wide", "false", False), ("wide", "TRUE", True),
        ("momentum", "1", 1.0), ("momentum", 1, 1.0), ("kind", "3", "3"), ("kind", "none", "none"),
        ("depth", "4", 4), ("depth", 4.0, 4), ("sizes", "[3,4]", [3, 4]), ("how", "b", "b"),
        ("limit", "None", None), ("limit", "null", None), ("limit", "2", 2.0),
        ("note", "none", None), ("note", "true", "true"), ("other", "False", False),
        ("other", "7", 7), ("other", "x7", "x7"), ("other", "[1, true]", [1, True]),
    ],
)  # fmt: skip
def test_an_option_is_of_the_type_of_its_parameter(option, given, stored):
    found = typed("m", factory, {option: given})[option]
    assert (found, type(found)) == (stored, type(stored))


@pytest.mark.parametrize(
    ("option", "given", "expected"),
    [
        ("wide", "yes", "true or false, got 'yes' .*default True"), ("wide", 1, "true or false"),
        ("depth", "2.5", "a whole number"), ("depth", "true", "a whole number"),
        ("momentum", "fast", "a finite number"), ("sizes", "3", "a list"), ("how", "c", "a, b"),
        ("limit", "x", "a finite number or none"), ("kind", 3, "text"), ("other", "NaN", "finite"),
        ("other", object(), "plain data"), ("k", "3", "no option 'k'"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_an_error_with_what_would(option, given, expected):
    with pytest.raises(InputError, match=expected):
        typed("m", factory, {option: given})


def test_what_is_the_default_makes_no_row_and_lists_are_tuples_where_meant():
    same = {"wide": "true", "momentum": "0.1", "depth": 3.0, "sizes": [1, 2], "limit": "none"}
    assert without_defaults(factory, typed("m", factory, same)) == {}
    other = typed("m", factory, {"sizes": "[2,2]", "more": "[1]"})
    assert without_defaults(factory, other) == other
    assert as_called(factory, other) == {"sizes": (2, 2), "more": [1]}


def test_options_and_recipe_are_told_apart():
    assert describe_changes({"lr": 0.002}, {"grid": 16}, {"name": "pm40:1a"}, "bf16-mixed") == (
        "grid=16; recipe lr=0.002; start pm40:1a; precision bf16-mixed"
    )
    assert describe_changes({}, {}) == ""
    values = (0.5, "0.5", True, "true", None, "none", "a b", "a", "a;b", "猫", "犬", "A", "NaN",
              "x; recipe lr=1", [1], "[1]", "x" * 230, "x" * 229)  # fmt: skip
    made = [describe_changes({}, {"momentum": v}) for v in values]
    made += [describe_changes({"momentum": v}, {}) for v in values]
    assert len(set(made)) == len(made)
    names = [file_name("my_model:make", one, "seed0").lower() for one in made]
    assert len(set(names)) == len(names)
    assert all(name.isascii() and len(name) < 160 and name[0] not in ".-" for name in names)
    assert file_name("papnet", "grid=16", "", "seed0") == "papnet_grid=16_seed0"
    for one, two in itertools.combinations(("./my-net.py:make", "my-net:make", "my_net:make"), 2):
        assert file_name(one) != file_name(two)


def test_pairs_of_the_command_line():
    assert arguments.pairs(["lr=0.01", "a=False", "b=None", "c=x=y"]) == {
        "lr": 0.01, "a": False, "b": None, "c": "x=y",
    }  # fmt: skip
    assert arguments.texts(["weights=123"]) == {"weights": "123"}
    assert plain("007") == "007"
    for wrong in (["lr"], ["=3"], ["a=1", "a=2"]):
        with pytest.raises(typer.BadParameter):
            arguments.texts(wrong)
