"""What a model takes in training and returns always. Checking records needs no torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor


class Prediction(NamedTuple):
    """A model's answer for a batch of B clouds.

    Attributes:
        class_logits: (B,K) float.
        pose_logits: (B,60) float over the rotation bins (``geometry.bins``), or None.
        penalty: scalar the model adds to its own training loss (PointNet's orthogonality term),
            already weighted, or None. A sum over the clouds of the batch: with several processes
            the harness adds up their shares' penalties, where it averages all other losses.
        candidates: of a model that decides over its k most confident poses: the highest class
            logit (B,k) under each, best pose first, and the class (B,k) it belongs to, or None. So
            every smaller ensemble can be scored without another run.
    """

    class_logits: Tensor
    pose_logits: Tensor | None = None
    penalty: Tensor | None = None
    candidates: tuple[Tensor, Tensor] | None = None


class Batch(NamedTuple):
    """A batch of training clouds, already augmented, on the model's device.

    Attributes:
        points: (B,N,3) float32, camera frame.
        label: (B,) int64.
        rotation: (B,3,3) float32 object → camera, after augmentation; NaN where nobody knows the
            poses, so that no loss is made of them in silence.
        mapped_rotation: (B,3,3) float32, ``rotation`` under the class's symmetry Map.
        normals: (B,N,3) float32 unit, camera frame, turned as the points are; None unless the model
            takes them.
    """

    points: Tensor
    label: Tensor
    rotation: Tensor
    mapped_rotation: Tensor
    normals: Tensor | None = None
