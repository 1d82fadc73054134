"""The shared computation over poses is one pose at a time, exactly."""

from __future__ import annotations

import pytest
import torch

from papnet.ensemble import classify_under_bins, decompose_bins, half_turn
from papnet.parts import Backbone, ClassHead, uniform
from papnet.rotate_field import rotate_field
from partialbench.geometry.bins import NUM_BINS, rotation_bins


def some_head() -> ClassHead:
    torch.manual_seed(0)
    head = ClassHead(7).double()
    with torch.no_grad():
        for _ in range(2):  # settle the statistics, so that no pose looks like another
            for module in head.modules():
                if hasattr(module, "momentum"):
                    module.momentum = 1.0
            head.train()(torch.randn(4, Backbone.fields.channels, 8, 8, 8).double())
    return head.eval()


def test_every_bin_is_permutation_half_turn_representative() -> None:
    d = decompose_bins()
    product = d.permutations[d.p] @ d.half_turns[d.s] @ d.representatives[d.h]
    assert torch.allclose(product.mT, torch.tensor(rotation_bins()), atol=1e-12)
    assert len(d.representatives) == 5
    triples = torch.stack([d.h, d.s, d.p], dim=1)
    assert len(triples.unique(dim=0)) == NUM_BINS


def test_half_turns_are_field_rotations() -> None:
    fields = uniform(2)
    field = torch.randn(1, fields.channels, 6, 6, 6, dtype=torch.float64)
    for turn in decompose_bins().half_turns:
        expected = rotate_field(field, turn[None], fields)
        assert torch.allclose(half_turn(field, turn, fields), expected, atol=1e-6)


def test_all_sixty_poses_at_once_are_sixty_poses_one_by_one() -> None:
    head = some_head()
    features = torch.randn(2, Backbone.fields.channels, 8, 8, 8, dtype=torch.float64)
    bins = torch.stack([torch.arange(NUM_BINS), torch.arange(NUM_BINS).flip(0)])
    with torch.no_grad():
        together = classify_under_bins(head, features, bins)
        inverse = torch.tensor(rotation_bins()).mT
        for b in range(0, NUM_BINS, 7):
            alone = head(rotate_field(features, inverse[bins[:, b]], Backbone.fields))
            assert torch.allclose(together[:, b], alone, atol=1e-5)
    # The answers do depend on the pose, so agreement says something.
    assert (together[0, 0] - together[0, 1]).abs().max() > 1e-2


@pytest.mark.parametrize("at_once", [1, 3])
def test_chunks_do_not_change_the_answer(monkeypatch: pytest.MonkeyPatch, at_once: int) -> None:
    head = some_head()
    features = torch.randn(3, Backbone.fields.channels, 4, 4, 4, dtype=torch.float64)
    bins = torch.tensor([[5, 1, 40], [7, 7, 2], [59, 30, 11]])
    with torch.no_grad():
        whole = classify_under_bins(head, features, bins)
        volume = features[0].numel() * features.element_size()
        monkeypatch.setattr("papnet.ensemble._CHUNK_BYTES", at_once * volume)
        assert torch.allclose(classify_under_bins(head, features, bins), whole, atol=1e-12)
