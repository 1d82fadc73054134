"""PAPNet as released, and the ablations of its paper's table 2 and pose figure as options of it.

Source: Xu et al., "Classification of Single-View Object Point Clouds" (arXiv:2012.10042v2);
TerenceHsu666/PAPNet@878adcc. What the release does and the paper does not say is kept: the noisy
pose is snapped to a bin, the ensemble compares raw logits, pooling drifts off the centre.
"""

from __future__ import annotations

import inspect
from typing import NamedTuple

import roma
import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from baselines.points import geometric, normalise
from baselines.steerable.convolution import SteerableConvolution
from papnet import pose
from papnet.ensemble import classify_under_bins
from papnet.parts import GRID, Backbone, ClassHead, PoseHead
from papnet.rotate_field import rotate_field
from partialbench.benchmark.prediction import Batch, Prediction
from partialbench.errors import InputError
from partialbench.geometry.bins import NUM_BINS
from partialbench.registry import close_matches


class Variant(NamedTuple):
    """One row of the paper's table 2.

    Attributes:
        pose: how the pose is estimated: "bins", "regression" or "" (not at all).
        transform: what is brought to the canonical pose: "features", "input" (the cloud, through
            the same backbone again), "cascade" (the cloud, into a second backbone), or "".
        given: the class branch sees the labelled pose with noise in training, not the predicted.
        ensemble: the class is decided over the k most confident poses, not the first alone.
    """

    pose: str = "bins"
    transform: str = "features"
    given: bool = True
    ensemble: bool = True


VARIANTS = {
    "without-pose": Variant(pose="", transform="", given=False, ensemble=False),
    "cascaded": Variant(transform="cascade", given=False, ensemble=False),
    "multi-task": Variant(transform="", given=False, ensemble=False),
    "input-transformation": Variant(transform="input"),
    "predicted-regression": Variant(pose="regression", given=False, ensemble=False),
    "predicted": Variant(given=False, ensemble=False),
    "predicted-ensemble": Variant(given=False),
    "ground-truth": Variant(),
}


EFFECTIVE = {
    "pose_weight": "pose",
    "symmetry": "pose",
    "vector_pose": "pose",
    "delta_deg": "given",
    "snap": "given",
    "k": "ensemble",
}
"""Option → what a variant must have for it to do anything."""

LIMIT = 32.0
"""As many clouds as a batch has, in the published recipe and in the common one."""

# Turned clouds that go through a backbone at a time.
_CANDIDATES_AT_ONCE = 16


class PAPNet(nn.Module):
    """Pose-accompanied point cloud classification network.

    Args:
        num_classes: K.
        variant: a row of the paper's table 2, see ``VARIANTS``.
        vector_pose: False is the pose figure's "w/o vector": scalars in the pose descriptor.
        symmetry: False is the pose figure's "w/o symmetry": labels are not mapped.
        k: poses in the ensemble, 1 to 60.
        delta_deg: half width of the noise on each Euler angle of the pose given in training.
        snap: use the bin nearest to the noisy pose, as released, rather than the pose itself.
        pose_weight: λ of the paper's total loss, 0 or more.
        grid: edge of the occupancy volume, a multiple of 8 from 16 on; the published 64.
        limit: of ``SteerableConvolution``, 0 for none, as released. Without it a few test clouds
            of any variant have logits of millions, which an ensemble by raw logits believes.

    Raises:
        InputError: an option that is not known, beyond its limits, or that changes nothing of the
            variant.
    """

    def __init__(
        self,
        num_classes: int,
        *,
        variant: str = "ground-truth",
        vector_pose: bool = True,
        symmetry: bool = True,
        k: int = 20,
        delta_deg: float = 45.0,
        snap: bool = True,
        pose_weight: float = 1.0,
        grid: int = GRID,
        limit: float = LIMIT,
    ) -> None:
        super().__init__()
        if variant not in VARIANTS:
            raise InputError(
                f"no PAPNet variant named {variant!r}{close_matches(variant, VARIANTS)}"
            )
        if not 1 <= k <= NUM_BINS:
            raise InputError(f"k must be between 1 and {NUM_BINS}, got {k}")
        if not 0 <= delta_deg <= 180:
            raise InputError(f"delta_deg must be between 0 and 180 degrees, got {delta_deg}")
        if pose_weight < 0:
            raise InputError(f"pose_weight must not be negative, got {pose_weight}")
        if grid < 16 or grid % 8:
            raise InputError(f"grid must be a multiple of 8, at least 16, got {grid}")
        if limit != 0 and limit < 1:
            raise InputError(f"limit must be 0 (none) or at least 1, got {limit}")
        _require_effect(
            variant, pose_weight=pose_weight, symmetry=symmetry, vector_pose=vector_pose,
            delta_deg=delta_deg, snap=snap, k=k,
        )  # fmt: skip
        self.variant, self.symmetry, self.k = VARIANTS[variant], symmetry, k
        self.delta_deg, self.snap, self.pose_weight, self.grid = delta_deg, snap, pose_weight, grid
        self.needs_poses = bool(self.variant.pose) or self.variant.given
        self.backbone = Backbone()
        if self.variant.pose:
            outputs = NUM_BINS if self.variant.pose == "bins" else 6
            self.pose_head = PoseHead(outputs, vector=vector_pose)
        if self.variant.transform == "cascade":
            self.second_backbone = Backbone()
        self.class_head = ClassHead(num_classes)
        for module in self.modules():
            if isinstance(module, SteerableConvolution):
                module.limit = limit or None

    def forward(self, points: Tensor, rotation: Tensor | None = None) -> Prediction:
        """Class and pose of clouds.

        Args:
            points: (B,N,3) camera frame, any scale and position.
            rotation: (B,3,3) object → camera, to be used as the pose; by default the model's own.

        Returns:
            class logits (B,K), the elementwise largest over the ensemble, so that their argmax is
            the class of the highest candidate; pose logits (B,60) unless the variant has none; the
            candidates where an ensemble decided.

        Raises:
            InputError: a rotation for a variant that turns nothing by it, or what is none.
        """
        if rotation is not None and not self.variant.transform:
            raise InputError("this variant classifies without a pose, so none can be given to it")
        rotation = None if rotation is None else pose.told(rotation, len(points))
        points = normalise(points)
        features = self.backbone(points, self.grid)
        pose_logits, predicted = self._pose(features)
        if rotation is None and pose_logits is not None and self._ensemble_size() > 1:
            ranked = pose_logits.topk(self._ensemble_size(), dim=1).indices
            under_poses = self._over_bins(points, features, ranked)
            loudest = under_poses.max(-1)
            return Prediction(
                under_poses.amax(1), pose_logits, candidates=(loudest.values, loudest.indices)
            )
        rotation = predicted if rotation is None else rotation
        logits = self._classify(points, features, rotation)
        return Prediction(logits, pose_logits)

    def training_loss(self, batch: Batch) -> Tensor:
        """CE of the class + λ·loss of the pose (the paper's L_total), a scalar."""
        points = normalise(batch.points)
        label = batch.mapped_rotation if self.symmetry else batch.rotation
        if self.variant.transform == "input":
            # Both streams as one batch: the norms' running statistics are of what they meet at
            # test, clouds as they come and turned ones.
            given = self._given(label)
            both = self.backbone(torch.cat([points, turned_back(points, given)]), self.grid)
            features, turned = both.chunk(2)
            pose_logits, predicted = self._pose(features)
            logits = self.class_head(turned)
        else:
            features = self.backbone(points, self.grid)
            pose_logits, predicted = self._pose(features)
            rotation = self._given(label) if self.variant.given else predicted
            logits = self._classify(points, features, rotation)
        loss = cross_entropy(logits, batch.label)
        if self.variant.pose == "bins":
            assert pose_logits is not None
            loss = loss + self.pose_weight * cross_entropy(pose_logits, pose.soft_target(label))
        elif self.variant.pose == "regression":
            assert predicted is not None
            distance = (predicted - label).square().sum((1, 2)).mean()
            loss = loss + self.pose_weight * distance
        return loss

    def _ensemble_size(self) -> int:
        # In training mode, a forward pass without a pose takes the most confident alone.
        return self.k if self.variant.ensemble and not self.training else 1

    def _given(self, label: Tensor) -> Tensor:
        noisy = pose.noise(label, self.delta_deg)
        return pose.bins(noisy)[pose.nearest_bin(noisy)] if self.snap else noisy

    def _pose(self, features: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """(scores of the bins (B,60), the pose itself (B,3,3)), None where there is no branch."""
        if not self.variant.pose:
            return None, None
        output = self.pose_head(features).float()
        if self.variant.pose == "bins":
            return output, pose.bins(output)[output.argmax(1)]
        # Two columns made orthonormal; from zero output, the identity.
        columns = output.view(-1, 3, 2) + torch.eye(3, 2, device=output.device)
        rotation = roma.special_gramschmidt(columns)
        return pose.similarity(rotation), rotation

    def _classify(self, points: Tensor, features: Tensor, rotation: Tensor | None) -> Tensor:
        """Class logits (B,K) under a pose, object → camera (B,3,3)."""
        transform = self.variant.transform
        if not transform:
            return self.class_head(features)
        assert rotation is not None
        if transform == "features":
            turned = rotate_field(features, rotation.transpose(1, 2), Backbone.fields)
        else:
            backbone = self.backbone if transform == "input" else self.second_backbone
            turned = backbone(turned_back(points, rotation), self.grid)
        return self.class_head(turned)

    def _over_bins(self, points: Tensor, features: Tensor, ranked: Tensor) -> Tensor:
        """Class logits (B,k,K) under the bins (B,k)."""
        if self.variant.transform == "features":
            return classify_under_bins(self.class_head, features, ranked)
        B, k = ranked.shape
        sample = torch.arange(B, device=ranked.device).repeat_interleave(k)
        rotation = pose.bins(features.float())[ranked.flatten()]
        logits = [
            self._classify(points[s], features[s], R)
            for s, R in zip(
                sample.split(_CANDIDATES_AT_ONCE),
                rotation.split(_CANDIDATES_AT_ONCE),
                strict=True,
            )
        ]
        return torch.cat(logits).view(B, k, -1)


@geometric
def turned_back(points: Tensor, rotation: Tensor) -> Tensor:
    """Clouds (B,N,3) by the inverse of their poses (B,3,3), about their centroids, so that they
    stay normalised. In a half precision a tenth of the points would fall into other voxels."""
    return points @ rotation.to(points.dtype)  # rows: Rᵀp = (pᵀR)ᵀ


def _require_effect(variant: str, **options: float) -> None:
    """Raises ``InputError`` for an option other than its default that the variant has no use for:
    its row would be named after what it does not have."""
    defaults = inspect.signature(PAPNet).parameters
    for name, value in options.items():
        if value != defaults[name].default and not getattr(VARIANTS[variant], EFFECTIVE[name]):
            takers = [key for key, each in VARIANTS.items() if getattr(each, EFFECTIVE[name])]
            raise InputError(
                f"{name}={value} changes nothing of variant {variant!r}; it is an option of "
                f"{', '.join(takers)}"
            )
