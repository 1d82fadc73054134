"""``papnet-steered`` and its twin without pose, ``papnet-steered-nopose``.

The paper's idea is kept: an equivariant descriptor of the cloud, brought to the canonical pose and
classified there. What differs: the descriptor is exactly equivariant, all 60 poses are tried, and
class and pose share one distribution p(pose, class), of which the class's probability is the sum
over poses and the pose's the sum over classes.

Source: Xu et al., arXiv:2012.10042v2, for the idea, the bins and the soft targets. The architecture
is this project's own.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import nll_loss

from baselines.points import full_precision
from papnet.pose import SOFT_WEIGHTS, bins
from papnet.steered.descriptor import Describe, Descriptor
from papnet.steered.head import InvariantHead, JointHead
from partialbench.benchmark.prediction import Batch, Prediction
from partialbench.errors import InputError

HIDDEN = 384


class PAPNetSteered(nn.Module):
    """Joint scores of pose and class from a steerable descriptor.

    Args:
        num_classes: K.
        lmax: highest degree of the descriptor, 1 to 3.
        channels: steerable channels of every degree.
        width: features of a point.
        k: nearest neighbours of a point.
        pose_weight: λ of the pose in the loss; 0 leaves the pose to be found as it helps the class.
        soft_targets: weights of the bins nearest to the label, nearest first, summing to 1; (1,) is
            the nearest alone.
    """

    def __init__(
        self,
        num_classes: int,
        *,
        lmax: int = 3,
        channels: int = 96,
        width: int = 128,
        k: int = 16,
        pose_weight: float = 0.3,
        soft_targets: Sequence[float] = SOFT_WEIGHTS,
    ) -> None:
        super().__init__()
        _check(lmax, channels, width, k)
        if pose_weight < 0:
            raise InputError(f"pose_weight must not be negative, got {pose_weight}")
        if not soft_targets or min(soft_targets) < 0 or abs(sum(soft_targets) - 1) > 1e-6:
            raise InputError(f"soft_targets must be weights that sum to 1, got {soft_targets}")
        self.pose_weight, self.soft_targets = pose_weight, tuple(soft_targets)
        self.describe = Describe(lmax, channels, width, k)
        self.head = JointHead(channels, width, lmax, HIDDEN, num_classes)
        self.bins: Tensor
        self.register_buffer("bins", bins(torch.zeros(0)).flatten(1), persistent=False)

    def descriptor(self, points: Tensor) -> Descriptor:
        """(B,N,3) → the steerable descriptor."""
        return self.describe(points)

    def joint(self, points: Tensor) -> Tensor:
        """log p(pose bin, class), (B,60,K), of clouds (B,N,3)."""
        return _log_joint(self.head(self.describe(points)))

    def forward(self, points: Tensor, rotation: Tensor | None = None) -> Prediction:
        """Class and pose of clouds.

        Args:
            points: (B,N,3) camera frame, any scale and position.
            rotation: (B,3,3) object → camera, where the pose is known; by default all bins count.

        Returns:
            log-probabilities of the class (B,K), the sum over the bins or under the given pose,
            and of the bin (B,60).
        """
        x = self.describe(points)
        joint = _log_joint(self.head(x))
        if rotation is None:
            classes = joint.logsumexp(1)
        else:
            if rotation.shape != (len(points), 3, 3):
                raise InputError(
                    f"expected one rotation per cloud, shape {(len(points), 3, 3)}, "
                    f"got {tuple(rotation.shape)}"
                )
            classes = full_precision(self.head(x, rotation[:, None])[:, 0]).log_softmax(-1)
        return Prediction(classes, joint.logsumexp(2))

    def training_loss(self, batch: Batch) -> Tensor:
        """CE of the class + λ·CE of (soft bins, class), a scalar."""
        joint = self.joint(batch.points)
        loss = nll_loss(joint.logsumexp(1), batch.label)
        if self.pose_weight:
            of_label = joint[torch.arange(len(joint), device=joint.device), :, batch.label]
            # The trace of R_bᵀ·R, which falls as the angle between them rises.
            similarity = batch.mapped_rotation.to(self.bins.dtype).flatten(1) @ self.bins.T
            order = similarity.topk(len(self.soft_targets)).indices
            nearest = of_label.gather(1, order)
            weights = nearest.new_tensor(self.soft_targets)
            loss = loss - self.pose_weight * (nearest @ weights).mean()
        return loss


class PAPNetSteeredNoPose(nn.Module):
    """The pose-free twin: same encoder and descriptor, its invariants into a classifier.

    Args:
        num_classes: K.
        lmax, channels, width, k: as of ``PAPNetSteered``.
    """

    def __init__(
        self,
        num_classes: int,
        *,
        lmax: int = 3,
        channels: int = 96,
        width: int = 128,
        k: int = 16,
    ) -> None:
        super().__init__()
        _check(lmax, channels, width, k)
        self.describe = Describe(lmax, channels, width, k)
        self.head = InvariantHead(channels, width, lmax, HIDDEN, num_classes)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        return Prediction(self.head(self.describe(points)))


def _log_joint(scores: Tensor) -> Tensor:
    """(B,P,K) scores → log-probabilities over all P·K."""
    return full_precision(scores).flatten(1).log_softmax(1).view_as(scores)


def _check(lmax: int, channels: int, width: int, k: int) -> None:
    if not 1 <= lmax <= 3:
        raise InputError(f"lmax must be 1, 2 or 3, got {lmax}")
    for name, value in (("channels", channels), ("width", width), ("k", k)):
        if value < 8:
            raise InputError(f"{name} must be at least 8, got {value}")
