"""What tests of boards share."""

from __future__ import annotations

import pytest

from leaderboard import consistency


@pytest.fixture
def made_up_models(monkeypatch):
    """Records are of models that no registry has, and are not held against it."""
    monkeypatch.setattr(consistency, "registry_faults", lambda result: iter(()))
