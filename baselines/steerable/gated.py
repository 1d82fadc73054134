"""The gated non-linearity: Weiler et al. 2018, section 4.3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.steerable.convolution import SteerableConvolution
from baselines.steerable.fields import Fields


class GatedBlock(nn.Module):
    """Steerable convolution, then ReLU(x + b) on scalars and v·σ(g + b) on fields of degree l > 0.

    The gates g are further scalar outputs of the same convolution, one per field, so the product
    is equivariant. Without fields of degree l > 0 there are no gates.

    Args:
        fields_in, fields_out: what the channels are.
        size, padding, stride, momentum, limit, formulation: as for ``SteerableConvolution``.
    """

    def __init__(
        self,
        fields_in: Fields,
        fields_out: Fields,
        size: int,
        *,
        padding: int = 0,
        stride: int = 1,
        momentum: float = 0.1,
        limit: float | None = None,
        formulation: str = "auto",
    ) -> None:
        super().__init__()
        scalars, *others = fields_out.multiplicities
        self.fields_in, self.fields_out = fields_in, fields_out
        self.convolution = SteerableConvolution(
            fields_in,
            Fields((scalars + sum(others), *others)),
            size,
            padding=padding,
            stride=stride,
            momentum=momentum,
            limit=limit,
            formulation=formulation,
        )
        self.scalar_bias = nn.Parameter(torch.zeros(scalars))
        self.gate_bias = nn.Parameter(torch.zeros(sum(others)))

    def forward(self, x: Tensor) -> Tensor:
        """(B,C_in,X,Y,Z) → (B,C_out,X',Y',Z')."""
        return self.gate(self.convolution(x))

    def gate(self, y: Tensor) -> Tensor:
        """The non-linearity alone: (B,C,X,Y,Z) with the gates after the scalars → (B,C_out,…)."""
        # As they lie: of a spectral convolution the channels are innermost. To stack them degree by
        # degree in another order would move every value twice, here and in the next layer.
        inner = y.stride(1) == 1
        axis = 4 if inner else 1
        y = y.permute(2, 3, 4, 0, 1) if inner else y
        bias = torch.cat([self.scalar_bias, self.gate_bias]).to(y.dtype)
        pre, rest = y.split([len(bias), y.shape[axis] - len(bias)], dim=axis)
        pre = pre + (bias if inner else bias.view(-1, 1, 1, 1))
        scalars, gates = pre.split([len(self.scalar_bias), len(self.gate_bias)], dim=axis)
        parts = [torch.relu(scalars)]
        gates = torch.sigmoid(gates)
        first = channel = 0
        for degree, m in enumerate(self.fields_out.multiplicities):
            if degree and m:
                components = 2 * degree + 1
                field = rest.narrow(axis, channel, m * components).unflatten(axis, (m, components))
                gate = gates.narrow(axis, first, m).unsqueeze(axis + 1)
                parts.append((field * gate).flatten(axis, axis + 1))
                first, channel = first + m, channel + m * components
        out = torch.cat(parts, dim=axis) if len(parts) > 1 else parts[0]
        return out.permute(3, 4, 0, 1, 2) if inner else out
