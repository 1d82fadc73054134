"""``papnet-steered`` and its twin without pose, ``papnet-steered-nopose``.

The paper's idea is kept: an equivariant descriptor of the cloud, brought to the canonical pose and
classified there. What differs: the descriptor is exactly equivariant, all poses of a grid are
tried, and class and pose share one distribution p(pose, class), of which the class's probability is
the sum over poses and the pose's the sum over classes.

Source: Xu et al., arXiv:2012.10042v2, for the idea, the bins and the soft targets. The architecture
is this project's own.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, nll_loss

from baselines.points import full_precision
from papnet.steered.descriptor import Describe, Descriptor
from papnet.steered.head import InvariantHead, JointHead, num_joint_weights
from papnet.steered.poses import pose_grid, share_of_bins
from partialbench.benchmark.prediction import Batch, Prediction
from partialbench.errors import InputError

HIDDEN, TWIN_HIDDEN = 312, 384


class PAPNetSteered(nn.Module):
    """Joint scores of pose and class from a steerable descriptor.

    Args:
        num_classes: K.
        lmax: highest degree of the descriptor, 1 to 3.
        channels: steerable channels of every degree.
        width: features of a point.
        k: nearest neighbours of a point.
        pose_weight: λ of the pose in the loss; 0 leaves the pose to be found as it helps the class.
        poses: how many poses are tried: the 60 bins, or 360 with the rotations between them.
        concentration: κ of the soft target, which falls with the angle θ from the label as
            exp(2κ·cos θ); 3 halves it at 28°, as far as a label can be from the grid of 360.
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
        poses: int = 360,
        concentration: float = 3.0,
    ) -> None:
        super().__init__()
        _check(lmax, channels, width, k)
        if pose_weight < 0:
            raise InputError(f"pose_weight must not be negative, got {pose_weight}")
        if concentration <= 0:
            raise InputError(f"concentration must be positive, got {concentration}")
        self.pose_weight, self.concentration = pose_weight, concentration
        self.describe = Describe(lmax, channels, width, k)
        self.head = JointHead(channels, width, lmax, HIDDEN, num_classes, poses)
        self.poses: Tensor
        self.share: Tensor
        grid, share = (torch.tensor(table(poses)).float() for table in (pose_grid, share_of_bins))
        self.register_buffer("poses", grid.flatten(1), persistent=False)
        self.register_buffer("share", share, persistent=False)

    def descriptor(self, points: Tensor) -> Descriptor:
        """(B,N,3) → the steerable descriptor."""
        return self.describe(points)

    def joint(self, points: Tensor) -> Tensor:
        """log p(pose, class), (B,P,K) over the grid's poses, of clouds (B,N,3)."""
        return _log_joint(self.head(self.describe(points)))

    def forward(self, points: Tensor, rotation: Tensor | None = None) -> Prediction:
        """Class and pose of clouds.

        Args:
            points: (B,N,3) camera frame, any scale and position.
            rotation: (B,3,3) object → camera, where the pose is known; by default all poses count.

        Returns:
            log-probabilities of the class (B,K), the sum over the poses, or unnormalised under the
            given one, so that answers under several poses compare; and log-probabilities of the
            bin (B,60), to which the poses nearest to it count.
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
            classes = full_precision(self.head(x, rotation[:, None])[:, 0])
        # The floor keeps the logarithm finite where every pose of a bin has underflowed.
        bins = (joint.logsumexp(2).exp() @ self.share).clamp_min(1e-30).log()
        return Prediction(classes, bins)

    def training_loss(self, batch: Batch) -> Tensor:
        """CE of the class + λ·CE of (soft pose, class), a scalar."""
        joint = self.joint(batch.points)
        loss = nll_loss(joint.logsumexp(1), batch.label)
        if self.pose_weight:
            of_label = joint[torch.arange(len(joint), device=joint.device), :, batch.label]
            # tr(R_pᵀ·R) = 1 + 2·cos θ.
            similarity = batch.mapped_rotation.to(self.poses.dtype).flatten(1) @ self.poses.T
            target = (self.concentration * similarity).softmax(1)
            loss = loss - self.pose_weight * (target * of_label).sum(1).mean()
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
        budget = num_joint_weights(channels, width, lmax, HIDDEN)
        self.head = InvariantHead(channels, width, lmax, TWIN_HIDDEN, num_classes, budget)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        return Prediction(self.head(self.describe(points)))

    def training_loss(self, batch: Batch) -> Tensor:
        """CE of the class, a scalar."""
        logits = self.head(self.describe(batch.points))
        return cross_entropy(full_precision(logits), batch.label)


def _log_joint(scores: Tensor) -> Tensor:
    """(B,P,K) scores → log-probabilities over all P·K."""
    return full_precision(scores).flatten(1).log_softmax(1).view_as(scores)


def _check(lmax: int, channels: int, width: int, k: int) -> None:
    if not 1 <= lmax <= 3:
        raise InputError(f"lmax must be 1, 2 or 3, got {lmax}")
    for name, value in (("channels", channels), ("width", width), ("k", k)):
        if value < 8:
            raise InputError(f"{name} must be at least 8, got {value}")
