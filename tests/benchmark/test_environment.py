"""What a record says it was made with."""

from __future__ import annotations

import partialbench
from partialbench.benchmark.environment import git_commit


def test_a_copy_without_its_repository_is_told_its_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(partialbench, "__file__", str(tmp_path / "partialbench" / "__init__.py"))
    monkeypatch.delenv("PARTIALBENCH_COMMIT", raising=False)
    assert git_commit() is None
    monkeypatch.setenv("PARTIALBENCH_COMMIT", "a" * 40)
    assert git_commit() == "a" * 40
