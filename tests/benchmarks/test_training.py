"""The table of what a training cloud costs."""

from __future__ import annotations

import pytest

from benchmarks.training import MODELS, table
from partialbench import registry


def test_ratios_and_their_geometric_mean() -> None:
    rows = {"pointnet": {"v1": 8.0, "now": 4.0}, "papnet": {"v1": 9.0, "now": 18.0}}
    head, _, pointnet, papnet, mean = table(rows, ["v1"], ["now"]).splitlines()
    assert head == "| model | v1 | now | v1 / now |"
    assert pointnet == "| pointnet | 8.00 | 4.00 | 2.00 |"
    assert papnet == "| papnet, grid 16 | 9.00 | 18.00 | 0.50 |"
    assert mean.split("|")[-2].strip() == "**1.00**"


@pytest.mark.parametrize("name", MODELS)
def test_the_papers_models_are_measured(name: str) -> None:
    assert name in registry.cards()
