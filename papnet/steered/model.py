"""``papnet-steered`` and its twin without pose, ``papnet-steered-nopose``.

The paper's idea is kept: an equivariant descriptor of the cloud, brought to the canonical pose and
classified there. What differs: the descriptor is exactly equivariant, all poses of a grid are
tried, and class and pose share one distribution p(pose, class), of which the class's probability is
the sum over poses and the pose's the sum over classes.

Source: Xu et al., arXiv:2012.10042v2, for the idea, the bins and the soft targets. The architecture
is this project's own.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, nll_loss, one_hot

from baselines.points import full_precision
from papnet.pose import similarity, to_each, told
from papnet.steered.descriptor import Describe, Descriptor
from papnet.steered.head import (
    InvariantHead,
    JointHead,
    View,
    num_joint_weights,
    wigner_entries,
)
from papnet.steered.poses import pose_grid, share_of_bins
from papnet.steered.refine import REFINED, climb
from partialbench.benchmark.prediction import Batch, Prediction
from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS

HIDDEN, TWIN_HIDDEN = 312, 384
CONCENTRATION = 3.0


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
        ray, scales: of ``Describe``.
        rounds: of scores, see ``SecondRound``.
        refine: at test, steps up the score from the most likely poses of the grid, whose scores
            take their place.
        votes: at test, so many windows of each cloud are asked and their probabilities averaged,
            each without another share of the points; 1 for the cloud as it is.
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
        concentration: float = CONCENTRATION,
        ray: bool = False,
        scales: int = 1,
        rounds: int = 1,
        refine: int = 0,
        votes: int = 1,
    ) -> None:
        super().__init__()
        _check(lmax, channels, width, k, scales, votes)
        if pose_weight < 0:
            raise InputError(f"pose_weight must not be negative, got {pose_weight}")
        if concentration <= 0:
            raise InputError(f"concentration must be positive, got {concentration}")
        if not pose_weight and concentration != CONCENTRATION:
            raise InputError(
                f"concentration={concentration} is of the pose's loss, which pose_weight=0 leaves "
                f"out; give one"
            )
        if rounds not in (1, 2):
            raise InputError(f"rounds must be 1 or 2, got {rounds}")
        if refine < 0:
            raise InputError(f"refine must not be negative, got {refine}")
        self.pose_weight, self.concentration = pose_weight, concentration
        self.needs_poses = pose_weight > 0
        self.refine, self.votes = refine, votes
        self.describe = Describe(lmax, channels, width, k, scales, ray)
        self.head = JointHead(channels, width, lmax, HIDDEN, num_classes, poses, rounds)
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
            log-probabilities of the class (B,K), the sum over the poses, or, under a given one, its
            scores as they are, so that those under several poses compare; and log-probabilities of
            the bin (B,60), to which the poses nearest to it count.

        Raises:
            InputError: clouds or rotations that are none, or more votes than points.
        """
        rotation = None if rotation is None else told(rotation, len(points))
        if self.training or self.votes == 1:
            classes, bins = self._answer(points, rotation)
        else:
            answers = [self._answer(each, rotation) for each in windows(points, self.votes)]
            classes, bins = map(torch.stack, zip(*answers, strict=True))
            # Scores under one pose are no probabilities: their mean is taken as they are.
            classes = classes.mean(0) if rotation is not None else _mean_of_logs(classes)
            bins = _mean_of_logs(bins)
        return Prediction(classes, bins)

    def _answer(self, points: Tensor, rotation: Tensor | None) -> tuple[Tensor, Tensor]:
        """Log-probabilities of the class (B,K), or scores under the given pose, and
        log-probabilities of the bin (B,60), of one window."""
        scores, view = self.head.look(self.describe(points))
        scores = full_precision(scores)
        share = self.share.expand(len(scores), -1, -1)
        if self.refine and not self.training:
            scores, share = self._refined(scores, share, view)
        joint = _log_joint(scores)
        # The floor keeps the logarithm finite where every pose of a bin has underflowed.
        of_poses = joint.logsumexp(2).exp()[:, None]
        bins = (of_poses @ share.to(joint.dtype))[:, 0].clamp_min(1e-30).log()
        if rotation is None:
            return joint.logsumexp(1), bins
        entries = wigner_entries(rotation[:, None].to(scores.device), self.head.lmax)
        return full_precision(self.head.scores(view, entries))[:, 0], bins

    def _refined(self, scores: Tensor, share: Tensor, view: View) -> tuple[Tensor, Tensor]:
        """Scores (B,P,K) and shares (B,P,60) with the likeliest poses moved to where they climb."""
        best = scores.logsumexp(2).topk(min(REFINED, scores.shape[1]), dim=1).indices
        begin = self.poses[best].unflatten(-1, (3, 3)).to(scores.dtype)
        # Products of rotations of a half precision are none.
        with torch.autocast(scores.device.type, enabled=False):
            context = None if view.context is None else full_precision(view.context)
            exact = View(full_precision(view.coefficients), full_precision(view.constant), context)
            rotation, climbed = climb(self.head, exact, begin, self.refine)
        scores = scores.scatter(1, best[..., None].expand_as(climbed), climbed)
        nearest = one_hot(similarity(rotation).argmax(2), NUM_BINS).to(share.dtype)
        return scores, share.scatter(1, best[..., None].expand_as(nearest), nearest)

    def training_loss(self, batch: Batch) -> Tensor:
        """CE of the class + λ·CE of (soft pose, class), a scalar."""
        joint = self.joint(batch.points)
        loss = nll_loss(joint.logsumexp(1), batch.label)
        if self.pose_weight:
            of_label = joint[torch.arange(len(joint), device=joint.device), :, batch.label]
            # tr(R_pᵀ·R) = 1 + 2·cos θ.
            near = to_each(batch.mapped_rotation.to(self.poses.dtype), self.poses)
            target = (self.concentration * near).softmax(1)
            loss = loss - self.pose_weight * (target * of_label).sum(1).mean()
        return loss


class PAPNetSteeredNoPose(nn.Module):
    """The pose-free twin: same encoder and descriptor, its invariants into a classifier.

    Args:
        num_classes: K.
        lmax, channels, width, k, ray, scales, votes: as of ``PAPNetSteered``.
    """

    def __init__(
        self,
        num_classes: int,
        *,
        lmax: int = 3,
        channels: int = 96,
        width: int = 128,
        k: int = 16,
        ray: bool = False,
        scales: int = 1,
        votes: int = 1,
    ) -> None:
        super().__init__()
        _check(lmax, channels, width, k, scales, votes)
        self.votes = votes
        self.describe = Describe(lmax, channels, width, k, scales, ray)
        budget = num_joint_weights(channels, width, lmax, HIDDEN)
        self.head = InvariantHead(channels, width, lmax, TWIN_HIDDEN, num_classes, budget)

    def forward(self, points: Tensor) -> Prediction:
        """(B,N,3) clouds in the camera frame → logits (B,K)."""
        if self.training or self.votes == 1:
            return Prediction(self.head(self.describe(points)))
        answers = [
            full_precision(self.head(self.describe(each))).log_softmax(1)
            for each in windows(points, self.votes)
        ]
        return Prediction(_mean_of_logs(torch.stack(answers)))

    def training_loss(self, batch: Batch) -> Tensor:
        """CE of the class, a scalar."""
        logits = self.head(self.describe(batch.points))
        return cross_entropy(full_precision(logits), batch.label)


def windows(points: Tensor, votes: int) -> list[Tensor]:
    """``votes`` ≥ 2 windows (B,n,3) of clouds (B,N,3), each without another N/votes of the points.

    Which those are the stored order says, which is random: the votes depend on it.

    Raises:
        InputError: more votes than points; those beyond would be of the whole cloud.
    """
    if votes > points.shape[1]:
        raise InputError(
            f"votes={votes} need clouds of at least {votes} points, to leave out others each time; "
            f"got {points.shape[1]}"
        )
    part = torch.arange(points.shape[1], device=points.device) % votes
    return [points[:, part != left_out] for left_out in range(votes)]


def _mean_of_logs(logs: Tensor) -> Tensor:
    """(V,…) → (…): the logarithm of the mean of what they are logarithms of."""
    return logs.logsumexp(0) - math.log(len(logs))


def _log_joint(scores: Tensor) -> Tensor:
    """(B,P,K) scores → log-probabilities over all P·K."""
    return full_precision(scores).flatten(1).log_softmax(1).view_as(scores)


def _check(lmax: int, channels: int, width: int, k: int, scales: int, votes: int) -> None:
    if not 1 <= lmax <= 3:
        raise InputError(f"lmax must be 1, 2 or 3, got {lmax}")
    for name, value in (("channels", channels), ("width", width), ("k", k)):
        if value < 8:
            raise InputError(f"{name} must be at least 8, got {value}")
    if scales not in (1, 2):
        raise InputError(f"scales must be 1 or 2, got {scales}")
    if votes < 1:
        raise InputError(f"votes must be at least 1, got {votes}")
