"""Models that look at more than the cloud they answer for."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from tests.benchmark.tiny_models import Bare


class WithPrior(Bare):
    """Adds the logarithm of the batch's class shares, as label-shift corrections do."""

    def forward(self, clouds):
        logits = super().forward(clouds)
        return logits + logits.softmax(1).mean(0).log()


class ByBatchSize(Bare):
    """Another answer for a cloud alone."""

    def forward(self, clouds):
        return super().forward(clouds) * (1.0 if len(clouds) > 1 else torch.tensor([1.0, 2.0, 3.0]))


class Adapting(Bare):
    """A running centre that goes on moving in tests, and a count that is no buffer."""

    def __init__(self, num_classes):
        super().__init__(num_classes)
        self.register_buffer("centre", torch.zeros(num_classes))
        self.calls = []

    def forward(self, clouds):
        logits = super().forward(clouds)
        self.calls.append(len(clouds))
        self.centre.mul_(0.5).add_(0.5 * logits.detach().mean(0))
        return logits - self.centre - 0.1 * len(self.calls)


class Counting(Bare):
    """Changes its answers with every batch it has seen, whatever is in it."""

    def __init__(self, num_classes):
        super().__init__(num_classes)
        self.seen = 0

    def forward(self, clouds):
        self.seen += 1
        logits = super().forward(clouds)
        return logits.roll(self.seen, dims=1)


class Drawing(Bare):
    """Keeps random points of each cloud, by torch and by NumPy."""

    def forward(self, clouds):
        kept = torch.randint(0, clouds.shape[1], (len(clouds), 4))
        kept = torch.cat([kept, kept + 0], dim=1)[:, : 3 + np.random.randint(1)]  # noqa: NPY002
        rows = torch.arange(len(clouds))[:, None]
        return super().forward(clouds[rows, kept])


class InPlace(Bare):
    """Centres what it is given where it is."""

    def forward(self, clouds):
        clouds -= clouds.mean(1, keepdim=True)
        clouds /= clouds.norm(dim=2).amax(1)[:, None, None]
        return super().forward(clouds)


class Centred(Bare):
    """The same on a copy."""

    def forward(self, clouds):
        clouds = clouds - clouds.mean(1, keepdim=True)
        return super().forward(clouds / clouds.norm(dim=2).amax(1)[:, None, None])


class Batchwise(nn.Module):
    """Normalises by the batch in tests too."""

    def __init__(self, num_classes):
        super().__init__()
        self.inner, self.norm = Bare(num_classes), nn.BatchNorm1d(num_classes)
        self.norm.track_running_stats = False
        self.norm.running_mean = self.norm.running_var = None

    def forward(self, clouds):
        logits = self.inner(clouds)
        return logits if len(clouds) == 1 else self.norm(logits)


class Remembering(Bare):
    """Leans to the classes that it answered before: a memory bank, in a list that two share."""

    def __init__(self, num_classes):
        super().__init__(num_classes)
        self.bank = []
        self.writer = nn.Identity()
        self.writer.bank = self.bank

    def forward(self, clouds):
        logits = super().forward(clouds)
        if self.bank:
            logits = logits + 3 * torch.stack(self.bank).mean(0)
        self.writer.bank.append(logits.detach().softmax(1).mean(0))
        return logits


class OwnGenerator(Bare):
    """Draws from a generator of its own."""

    def __init__(self, num_classes):
        super().__init__(num_classes)
        self.draws = torch.Generator().manual_seed(3)

    def forward(self, clouds):
        logits = super().forward(clouds)
        return logits + torch.rand(logits.shape, generator=self.draws)


class Hooked(Bare):
    """Answers by what a hook of its own has noted of a layer, and through a list of layers."""

    def __init__(self, num_classes):
        super().__init__(num_classes)
        self.watched = nn.Linear(num_classes, num_classes)
        self.same = [self.watched]
        self.watched.register_forward_hook(self._note)
        self.noted = None

    def _note(self, layer, given, output):
        self.noted = output

    def forward(self, clouds):
        self.noted = None
        logits = super().forward(clouds)
        self.same[0](logits)
        return logits + self.noted
