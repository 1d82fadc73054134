"""The steerable convolution with the normalisation that precedes it.

One linear map, computed in whichever of three ways is cheapest (they agree to rounding):

assembled    κ = Σ_b w_b·basis_b is summed into one dense kernel, then one ``conv3d``.
factorised   the fixed basis is convolved first, field by field, then w mixes the results. A dense
             kernel couples every pair of fields through size³ taps; the basis couples a pair
             through one to ten numbers, so for many fields this is several times less work, and
             its gradient needs no kernel at all.
spectral     the dense kernel's transform meets the volume's, frequency by frequency (CPU only).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from baselines.processes import pooled
from baselines.steerable.basis import kernel_basis, kernel_gain
from baselines.steerable.factorised import FactorisedConvolution, Geometry
from baselines.steerable.fields import Fields
from baselines.steerable.spectral import Plan, convolve, convolve_factorised, transform

# The factorised way moves more memory per multiplication than a dense convolution does; measured
# on CPU, forward and training step, it wins once it saves this factor of multiplications.
_FACTORISED_ABOVE = 4.0

# The same for the spectral way, by whether gradients are needed: a dense convolution's are slow.
# Measured on one core with AVX-512, sizes 3 and 5, edges 3 to 14, batches of 16 and 32.
_SPECTRAL_ABOVE = {True: 3.0, False: 16.0}
# And the most that a transformed kernel may take.
_SPECTRUM_BYTES = 640 << 20


class SteerableConvolution(nn.Module):
    """Normalise the input fields, then convolve them with a learned steerable kernel.

    Normalisation (source: se3cnn@546bc68): a scalar field is centred and divided by its standard
    deviation; a field of degree l > 0 is divided by √mean‖v‖², the mean running over batch and
    volume and the norm over its 2l+1 components. There is no affine part. It is folded into the
    kernel: the centring becomes a constant bias, so the zero padding is not centred.

    Args:
        fields_in, fields_out: what the channels are.
        size: kernel edge in voxels, odd.
        padding, stride: as for ``conv3d``.
        momentum, eps: of the running statistics.
        limit: in evaluation, a field whose mean square in a cloud is more than ``limit`` times the
            running one is scaled down to that; None leaves it as se3cnn does. In training no cloud
            of a batch of B can exceed B times the batch's mean, and one that is all of it is
            divided by itself. Running statistics promise nothing of the kind: a field that ReLUs
            kept at zero has a variance of ``eps``, and the rare cloud that wakes it up comes out
            300 times too large, layer after layer. Other clouds are not touched, to the last bit.
        formulation: "assembled", "factorised", "spectral" (cubes only), or "auto": the first two
            by their work, and on a CPU the third where the volume at hand makes it cheaper.

    Weights are N(0,1) at first and kept per output degree: ``weights[l]`` is (m_out, Σ_i m_i·n_il),
    columns ordered by input degree, then field, then basis element.
    """

    running_mean: Tensor
    running_var: Tensor

    def __init__(
        self,
        fields_in: Fields,
        fields_out: Fields,
        size: int,
        *,
        padding: int = 0,
        stride: int = 1,
        momentum: float = 0.1,
        eps: float = 1e-5,
        limit: float | None = None,
        formulation: str = "auto",
    ) -> None:
        super().__init__()
        self.fields_in, self.fields_out = fields_in, fields_out
        self.size, self.padding, self.stride = size, padding, stride
        self.momentum, self.eps, self.limit = momentum, eps, limit
        self.formulation = self._choose(formulation)
        self._may_be_spectral = formulation in ("auto", "spectral")
        self.weights = nn.ParameterDict()
        fields_before = {}
        start = 0
        for l_in, m_in, _ in fields_in.degrees:
            fields_before[l_in] = start
            start += m_in
        for l_out, m_out, _ in fields_out.degrees:
            column_field = []
            for l_in, m_in, _ in fields_in.degrees:
                basis, labels = kernel_basis(l_in, l_out, size)
                gain = kernel_gain(l_out, len(labels), fields_in.count)
                self._constant(f"basis_{l_out}_{l_in}", (gain * basis).float())
                first = fields_before[l_in]
                field = torch.arange(first, first + m_in)
                column_field.append(field.repeat_interleave(len(labels)))
            column = torch.cat(column_field)
            self._constant(f"column_field_{l_out}", column)
            self.weights[str(l_out)] = nn.Parameter(torch.randn(m_out, len(column)))
        self.register_buffer("running_mean", torch.zeros(fields_in.multiplicities[0]))
        self.register_buffer("running_var", torch.ones(fields_in.count))
        # Spectral with its basis first, where that makes fewer volumes than come out.
        self._mixes_later = self._geometry(padding).mixed_channels < fields_out.channels
        self._cache: tuple[tuple, Tensor, Tensor] | None = None

    def _constant(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    def extra_repr(self) -> str:
        return (
            f"{self.fields_in.multiplicities} → {self.fields_out.multiplicities}, "
            f"size={self.size}, padding={self.padding}, stride={self.stride}, {self.formulation}"
        )

    def _basis(self, l_out: int, l_in: int) -> Tensor:
        return self.get_buffer(f"basis_{l_out}_{l_in}")

    def _choose(self, formulation: str) -> str:
        if formulation not in ("auto", "assembled", "factorised", "spectral"):
            raise ValueError(
                "formulation must be 'auto', 'assembled', 'factorised' or 'spectral', "
                f"got {formulation!r}"
            )
        if formulation != "auto":
            return formulation
        taps = self.size**3
        dense = self.fields_in.channels * self.fields_out.channels * taps
        factorised = 0
        for l_in, m_in, _ in self.fields_in.degrees:
            for l_out, m_out, _ in self.fields_out.degrees:
                mixed = len(kernel_basis(l_in, l_out, self.size)[1]) * (2 * l_out + 1) * m_in
                factorised += mixed * ((2 * l_in + 1) * taps + m_out)
        return "factorised" if dense > _FACTORISED_ABOVE * factorised else "assembled"

    def train(self, mode: bool = True) -> SteerableConvolution:
        self._cache = None
        return super().train(mode)

    def forward(self, x: Tensor) -> Tensor:
        """(B,C_in,X,Y,Z) → (B,C_out,X',Y',Z')."""
        if x.dim() != 5 or x.shape[1] != self.fields_in.channels:
            raise ValueError(
                f"expected (B,{self.fields_in.channels},X,Y,Z) for fields "
                f"{self.fields_in.multiplicities}, got {tuple(x.shape)}"
            )
        low_precision = torch.is_autocast_enabled(x.device.type)
        with torch.autocast(x.device.type, enabled=False):
            mean, var = self._statistics(x)
            if self.limit is not None and not self.training:
                x = self._limited(x, mean, var, self.limit)
            padding = self.padding
            plan = self._plan(x)
            if plan and self._mixes_later:
                weights = self._normalised_weights(var)
                bias = self._bias(weights, mean)
                x = x.to(bias.dtype)
                y = convolve_factorised(x, self._geometry(self.padding), weights, plan)
                return y + bias.view(-1, 1, 1, 1)
            if plan:
                spectrum, bias = self._normalised_kernel(mean, var, plan)
                return convolve(x.to(spectrum.dtype), spectrum, plan) + bias.view(-1, 1, 1, 1)
            if low_precision:
                # Centring by a bias subtracts two large numbers where a field is nearly constant,
                # as most of a sparse volume is; what half precision loses there swamps the rest.
                x = self._centred(x, mean)
                padding = 0
            if self.formulation == "assembled":
                operands = self._normalised_kernel(mean, var)
            else:
                weights = self._normalised_weights(var)
                bias = self._bias(weights, mean)
        if self.formulation == "assembled":
            kernel, bias = operands
            return nn.functional.conv3d(
                x, kernel, None if low_precision else bias, stride=self.stride, padding=padding
            )
        y = FactorisedConvolution.apply(x, self._geometry(padding), *weights)
        return y if low_precision else y + bias.view(-1, 1, 1, 1)

    def _plan(self, x: Tensor) -> Plan | None:
        """The sizes of the spectral way, where it is to be taken; it is in full precision."""
        if not self._may_be_spectral:
            return None
        edges = set(x.shape[2:])
        plan = Plan(x.shape[2], self.size, self.padding, self.stride)
        if self.formulation == "spectral":
            if len(edges) > 1 or plan.out < 1:
                raise ValueError(
                    "the spectral formulation needs a cube no smaller than the kernel, "
                    f"got {tuple(x.shape[2:])}"
                )
            return plan
        if len(edges) > 1 or plan.out < 1 or x.device.type != "cpu":
            return None
        gradients = torch.is_grad_enabled() and any(w.requires_grad for w in self.weights.values())
        channels = self.fields_in.channels, self.fields_out.channels
        dense = len(x) * plan.dense_work(*channels)
        spectral = len(x) * plan.work(*channels) + plan.kernel_work(*channels)
        size = plan.spectrum_size(*channels) * x.element_size()
        fits = self._mixes_later or size <= _SPECTRUM_BYTES
        return plan if fits and dense > _SPECTRAL_ABOVE[gradients] * spectral else None

    def _centred(self, x: Tensor, mean: Tensor) -> Tensor:
        """The padded input less the mean, in float32: the padding is zero, so it becomes −mean."""
        padded = nn.functional.pad(x.float(), (self.padding,) * 6)
        shift = nn.functional.pad(mean, (0, self.fields_in.channels - len(mean)))
        return padded - shift.view(-1, 1, 1, 1)

    def _statistics(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(mean of the scalar fields (m_0,), variance or mean ‖v‖² of every field (count,))."""
        if not self.training:
            return self.running_mean, self.running_var
        x = x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
        mean = self.running_mean
        var = []
        for degree, m, channels in self.fields_in.degrees:
            part = x[:, channels].unflatten(1, (m, 2 * degree + 1))
            if degree == 0:
                scalar_var, mean = torch.var_mean(part, (0, 2, 3, 4, 5), correction=0)
                var.append(scalar_var)
            else:
                var.append(part.square().mean((0, 3, 4, 5)).sum(1))
        values = len(x) * x[0, 0].numel()
        mean, var_all, _ = pooled(mean, torch.cat(var), values)
        with torch.no_grad():
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), self.momentum)
            self.running_var.lerp_(var_all.to(self.running_var.dtype), self.momentum)
        return mean, var_all

    def _limited(self, x: Tensor, mean: Tensor, var: Tensor, limit: float) -> Tensor:
        """The input, each cloud's fields scaled to at most ``limit`` times the mean square."""
        squares = []
        for degree, m, channels in self.fields_in.degrees:
            part = x[:, channels].unflatten(1, (m, 2 * degree + 1)).flatten(3).float()
            if degree == 0:
                part = part - mean[:, None, None]
            squares.append(part.square().sum(2).mean(2))
        most = limit * (var + self.eps)
        scale = (most / torch.cat(squares, dim=1).maximum(most)).sqrt()
        if bool((scale == 1).all()):
            return x
        sizes = torch.tensor([2 * d + 1 for d, m, _ in self.fields_in.degrees for _ in range(m)])
        scale = scale.repeat_interleave(sizes.to(x.device), dim=1)
        # Scalars shrink towards their mean; with a scale of 1 nothing is added.
        towards = nn.functional.pad(mean, (0, x.shape[1] - len(mean))) * (1 - scale)
        scale, towards = (t.to(x.dtype)[..., None, None, None] for t in (scale, towards))
        return x * scale + towards

    def _normalised_weights(self, var: Tensor) -> list[Tensor]:
        """The weights, each column divided by its input field's scale."""
        scale = (var + self.eps).rsqrt()
        return [
            self.weights[str(degree)] * scale[self.get_buffer(f"column_field_{degree}")]
            for degree, _, _ in self.fields_out.degrees
        ]

    def _bias(self, weights: list[Tensor], mean: Tensor) -> Tensor:
        """(C_out,) minus the kernel's answer to the constant field ``mean``.

        Only scalars answer a constant: Y_l, l ≥ 1, sums to zero over the grid's cubic symmetry for
        every l < 4 that occurs here with scalar input.
        """
        bias = mean.new_zeros(self.fields_out.channels)
        (l_out, m_out, _), *_ = self.fields_out.degrees
        if l_out == 0 and len(mean):
            response = self._basis(0, 0).sum((1, 2, 3, 4, 5))
            columns = weights[0][:, : len(mean) * len(response)]
            answer = columns.view(m_out, len(mean), -1) @ response.to(columns.dtype) @ mean
            bias = torch.cat([-answer, bias[m_out:]])
        return bias

    def _geometry(self, padding: int) -> Geometry:
        pairs = [
            [self._basis(l_out, l_in) for l_in, _, _ in self.fields_in.degrees]
            for l_out, _, _ in self.fields_out.degrees
        ]
        return Geometry(self.fields_in, self.fields_out, pairs, padding, self.stride)

    def kernel(self, weights: list[Tensor] | None = None) -> Tensor:
        """The dense kernel (C_out,C_in,size,size,size), by default of the raw weights."""
        if weights is None:
            weights = [self.weights[str(degree)] for degree, _, _ in self.fields_out.degrees]
        rows = []
        for weight, (l_out, m_out, _) in zip(weights, self.fields_out.degrees, strict=True):
            blocks, start = [], 0
            for l_in, m_in, _ in self.fields_in.degrees:
                basis = self._basis(l_out, l_in).to(weight.dtype)
                n = len(basis)
                w = weight[:, start : start + m_in * n].reshape(m_out * m_in, n)
                block = (w @ basis.flatten(1)).view(m_out, m_in, *basis.shape[1:])
                blocks.append(block.transpose(1, 2).flatten(2, 3).flatten(0, 1))
                start += m_in * n
            rows.append(torch.cat(blocks, dim=1))
        return torch.cat(rows)

    def normalised_kernel(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The dense kernel (C_out,C_in,s,s,s) and bias (C_out,) with the normalisation folded in.

        In training they carry the statistics of ``x`` (B,C_in,X,Y,Z), and the running ones are
        updated; in evaluation they are kept between calls until a weight changes.
        """
        return self._normalised_kernel(*self._statistics(x))

    def _normalised_kernel(
        self, mean: Tensor, var: Tensor, plan: Plan | None = None
    ) -> tuple[Tensor, Tensor]:
        """Kernel and bias; the kernel transformed, if there is a plan."""
        state = (*self.weights.values(), self.running_mean, self.running_var)
        # A tensor's version counts its in-place changes; its address changes with its device.
        key = (plan, *((t.data_ptr(), t._version, t.dtype) for t in state))
        keep = not self.training and not torch.is_grad_enabled()
        if keep and self._cache is not None and self._cache[0] == key:
            return self._cache[1:]
        weights = self._normalised_weights(var)
        kernel, bias = self.kernel(weights), self._bias(weights, mean)
        if plan:
            kernel = transform(kernel, plan)
        if keep:
            self._cache = (key, kernel, bias)
        return kernel, bias
