"""Reading the weights of se3cnn (mariogeiger/se3cnn@546bc68), the steerable CNN authors' library.

se3cnn writes degree-1 components as (y, z, x) and its harmonics follow: its degree-l components are
D^l(A) times ours, A the cyclic permutation of the axes. Its kernel basis spans the same space as
ours, element by element up to sign. The signs are not assumed: every published state carries its
own basis (``kernel_i_j``), which is solved for in ours, and a basis that does not fit is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from baselines.steerable.basis import kernel_basis, kernel_gain
from baselines.steerable.fields import Fields, wigner_matrix
from baselines.steerable.gated import GatedBlock
from partialbench.errors import InputError

# (x, y, z) → (y, z, x)
_CYCLE = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)

_BASIS_TOLERANCE = 1e-5


def change_of_basis(degree: int) -> Tensor:
    """(2l+1,2l+1) float64, C with published components = C · ours."""
    return wigner_matrix(degree, _CYCLE)


def _changes(fields: Fields, *, inverse: bool) -> dict[int, Tensor]:
    changes = {degree: change_of_basis(degree) for degree, _, _ in fields.degrees}
    return {degree: C.T for degree, C in changes.items()} if inverse else changes


def field_from_published(field: Tensor, fields: Fields) -> Tensor:
    """A feature (B,C,…) in se3cnn's components → ours."""
    return fields.rotate_components(field, _changes(fields, inverse=True))


def field_to_published(field: Tensor, fields: Fields) -> Tensor:
    """A feature (B,C,…) in our components → se3cnn's."""
    return fields.rotate_components(field, _changes(fields, inverse=False))


def linear_from_published(weight: Any, fields: Fields) -> Tensor:
    """A linear layer's (out,C) weight that reads pooled se3cnn features → one that reads ours."""
    # W·(C·f) = (Cᵀ·Wᵀ)ᵀ·f: the rows of W change as features do.
    return field_from_published(_tensor(weight), fields)


def _tensor(array: Any) -> Tensor:
    return torch.as_tensor(array).detach().float().cpu()


def _basis_in_ours(published: Tensor, l_in: int, l_out: int, fields_in: int) -> Tensor:
    """T (n,n) float64: published element b = Σ_c T[b,c]·(our element c in their components)."""
    basis, labels = kernel_basis(l_in, l_out, published.shape[-1])
    ours = kernel_gain(l_out, len(labels), fields_in) * torch.einsum(
        "op,bpqxyz,iq->boixyz", change_of_basis(l_out), basis, change_of_basis(l_in)
    )
    if published.shape != ours.shape:
        raise InputError(
            f"the published kernel basis from degree {l_in} to {l_out} has shape "
            f"{tuple(published.shape)}, expected {tuple(ours.shape)}: its layer is another one"
        )
    target = published.double().flatten(1)
    T = torch.linalg.lstsq(ours.flatten(1).T, target.T).solution.T
    misfit = float((T @ ours.flatten(1) - target).abs().max())
    if misfit > _BASIS_TOLERANCE:
        raise InputError(
            f"the published kernel basis from degree {l_in} to {l_out} is off ours by {misfit:.1e} "
            f"(tolerance {_BASIS_TOLERANCE}): it was made with other shells, cut-off or width"
        )
    return T


def gated_block_state(
    published: Mapping[str, Any], block: GatedBlock, prefix: str = ""
) -> dict[str, Tensor]:
    """``block``'s state from an se3cnn ``GatedBlock`` with batch norm.

    Args:
        published: se3cnn's names (``scalar_act.bias``, ``conv.kernel.weight``, …) → arrays.
        block: only its shape is read.
        prefix: what precedes the names, e.g. "conv1.".

    Raises:
        InputError: a name is missing, or a shape or the kernel basis is another layer's.
    """

    def get(name: str) -> Tensor:
        if prefix + name not in published:
            raise InputError(f"the published state has no {prefix + name!r}")
        return _tensor(published[prefix + name])

    fields_in = block.fields_in
    scalars, *others = block.fields_out.multiplicities
    # Their output types: the fields by degree, then the gates as scalars of their own.
    types = [(degree, m) for degree, m in enumerate(block.fields_out.multiplicities) if m]
    if sum(others):
        types.append((0, sum(others)))
    flat = get("conv.kernel.weight")
    by_degree: dict[int, list[Tensor]] = {}
    start = 0
    for i, (l_out, m_out) in enumerate(types):
        columns = []
        for j, (l_in, m_in, _) in enumerate(fields_in.degrees):
            T = _basis_in_ours(get(f"conv.kernel.kernel_{i}_{j}"), l_in, l_out, fields_in.count)
            stop = start + m_out * m_in * len(T)
            if stop > len(flat):
                raise InputError(
                    f"{prefix}conv.kernel.weight has {len(flat)} numbers, too few for "
                    f"{fields_in.multiplicities} → {block.fields_out.multiplicities}"
                )
            weight = flat[start:stop].view(m_out, m_in, len(T)) @ T.float()
            columns.append(weight.flatten(1))
            start = stop
        by_degree.setdefault(l_out, []).append(torch.cat(columns, dim=1))
    if start != len(flat):
        raise InputError(
            f"{prefix}conv.kernel.weight has {len(flat)} numbers, expected {start} for "
            f"{fields_in.multiplicities} → {block.fields_out.multiplicities}"
        )
    state = {f"convolution.weights.{degree}": torch.cat(rows) for degree, rows in by_degree.items()}
    state["convolution.running_mean"] = get("conv.running_mean")
    state["convolution.running_var"] = get("conv.running_var")
    state["scalar_bias"] = get("scalar_act.bias") if scalars else torch.zeros(0)
    state["gate_bias"] = get("gate_act.bias") if sum(others) else torch.zeros(0)
    return state
