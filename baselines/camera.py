"""What a cloud in the camera frame says of its camera."""

from __future__ import annotations

import torch
from torch import Tensor

from baselines.points import full_precision
from partialbench.errors import InputError


@torch.no_grad()
def camera_ray(points: Tensor) -> Tensor:
    """The direction (B,3) from the camera, the origin, to each cloud's centroid; of length 1.

    It turns with a cloud that is turned about the camera, as training turns it, and does not with
    one that is turned about itself.

    Args:
        points: (B,N,3) in the camera frame, before any centring.

    Raises:
        InputError: if a cloud is centred: there is no telling where its camera was.
    """
    points = full_precision(points)
    centroid = points.double().mean(dim=1)
    distance = torch.linalg.vector_norm(centroid, dim=-1)
    extent = torch.linalg.vector_norm(points - centroid[:, None], dim=-1).amax(dim=1)
    if bool((distance <= 1e-3 * extent).any()):
        raise InputError(
            "a cloud is centred on the origin, so nothing says where its camera was; the camera's "
            "ray needs clouds in the camera frame, as they are stored"
        )
    return (centroid / distance[:, None]).to(points.dtype)
