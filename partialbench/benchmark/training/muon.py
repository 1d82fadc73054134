"""Muon: matrices move by the orthogonal part of their momentum, all else as with AdamW.

A step of SGD or Adam on a weight matrix is dominated by a few directions of large gradient. Muon
takes the momentum's singular vectors and sets its singular values to about one, so that directions
of small gradient are learned as fast. The values come from five Newton–Schulz steps, which take
matrix products alone.

``torch.optim.Muon`` takes matrices only, orthogonalises in bfloat16 and needs torch 2.9. This one
is one optimiser for a whole model, in the gradients' own precision.

Source: Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024; the scale
that lets learning rate and weight decay of AdamW stand: Liu et al., "Muon is scalable for LLM
training", arXiv:2502.16982, section 2.2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

MOMENTUM = 0.95
BETAS, EPS = (0.9, 0.999), 1e-8
"""Of the AdamW part, torch's defaults."""
RMS = 0.2
"""Root mean square of a matrix's step over its learning rate: about AdamW's own."""
_NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)


def orthogonalised(matrix: Tensor) -> Tensor:
    """U·S'·Vᵀ of a matrix U·S·Vᵀ (m,n), with every S' near one (0.7 to 1.2)."""
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide / (torch.linalg.matrix_norm(wide) + 1e-7)
    a, b, c = _NEWTON_SCHULZ
    for _ in range(5):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x if x.shape == matrix.shape else x.T


class Muon(Optimizer):
    """Muon for parameters of two dimensions or more, a kernel's inputs flattened; else AdamW.

    Args:
        parameters: of the model.
        lr, weight_decay: as of AdamW, the decay decoupled.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], lr: float, weight_decay: float = 0.0
    ) -> None:
        super().__init__(parameters, {"lr": lr, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """One step; returns what ``closure``, if given, returned."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                update = _muon if parameter.ndim >= 2 else _adam
                direction = update(parameter.grad, self.state[parameter])
                parameter.mul_(1 - group["lr"] * group["weight_decay"])
                parameter.sub_(direction, alpha=group["lr"])
        return loss


def _muon(gradient: Tensor, state: dict[str, Any]) -> Tensor:
    if not state:
        state["momentum"] = torch.zeros_like(gradient)
    momentum = state["momentum"].lerp_(gradient, 1 - MOMENTUM)
    # Nesterov's look ahead.
    ahead = gradient.lerp(momentum, MOMENTUM).flatten(1)
    # An orthogonal (m,n) has a root mean square of 1/√max(m,n).
    return (orthogonalised(ahead) * (RMS * max(ahead.shape) ** 0.5)).view_as(gradient)


def _adam(gradient: Tensor, state: dict[str, Any]) -> Tensor:
    if not state:
        state["step"] = torch.zeros(())
        state["mean"], state["square"] = torch.zeros_like(gradient), torch.zeros_like(gradient)
    state["step"] += 1
    mean = state["mean"].lerp_(gradient, 1 - BETAS[0])
    square = state["square"].lerp_(gradient.square(), 1 - BETAS[1])
    rescale = [1 - beta ** state["step"].item() for beta in BETAS]
    return mean / rescale[0] / ((square / rescale[1]).sqrt() + EPS)
