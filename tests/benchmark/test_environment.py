"""What a record says it was made with."""

from __future__ import annotations

import torch

import partialbench
from partialbench.benchmark import device
from partialbench.benchmark.environment import describe, git_commit
from partialbench.benchmark.fabric import make_fabric


def test_a_copy_without_its_repository_is_told_its_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(partialbench, "__file__", str(tmp_path / "partialbench" / "__init__.py"))
    monkeypatch.delenv("PARTIALBENCH_COMMIT", raising=False)
    assert git_commit() is None
    monkeypatch.setenv("PARTIALBENCH_COMMIT", "a" * 40)
    assert git_commit() == "a" * 40


def test_arithmetic_is_said(caplog, monkeypatch):
    """A record says whether bfloat16 had instructions; who asks for it where it is slow is told."""
    assert "bf16_instructions" not in describe(torch.device("cpu"))
    assert isinstance(
        describe(torch.device("cpu"), precision="bf16-mixed")["bf16_instructions"], bool
    )
    monkeypatch.setattr(device, "bf16_gain", lambda: 0.25)
    make_fabric("cpu", "32-true")
    assert not caplog.records
    make_fabric("cpu", "bf16")
    assert "takes 4.0 times as long" in caplog.text


def test_the_gain_of_bf16_is_measured():
    assert 0.001 < device.bf16_gain() < 1000
