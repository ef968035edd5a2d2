"""Forward and backward of a residual network by hand, for one network or an ensemble of equal ones.

The same numbers as `ResidualMLP` gives layer by layer, with less work: no autograd node per operation, weights that
were cast to bfloat16 once per update instead of at every use, no gradient that nobody asked for. On CPUs only; see
`ResidualMLP.forward` for when it is taken.

Numerics at bfloat16: products accumulate in float32, layer-norm statistics, heads, parameters and their gradients are
float32; activations between the layers are bfloat16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

_ROWS = 32  # granularity of the row-sparse backward: few distinct sizes keep oneDNN's cache of kernels small


@dataclass(frozen=True)
class Layer:
    """Shape facts of one residual layer."""

    in_features: int
    out_features: int
    side: str
    narrowing: str
    eps: float
    norm: bool

    def skip(self, x: Tensor, hidden: Tensor, *, inplace: bool) -> Tensor:
        """Return `hidden + fit(x)`; `hidden` may be overwritten if `inplace`."""
        n, m = self.in_features, self.out_features
        if n < m:
            out = hidden if inplace else hidden.clone()
            (out[:, :n] if self.side == "end" else out[:, m - n :]).add_(x)
            return out
        if n > m:
            x = x[:, :m] if self._keeps_first else x[:, n - m :]
        return hidden.add_(x) if inplace else hidden + x

    def skip_adjoint(self, grad: Tensor) -> Tensor:
        """Gradient of `fit(x)` with respect to x."""
        n, m = self.in_features, self.out_features
        if n < m:
            return grad[:, :n] if self.side == "end" else grad[:, m - n :]
        if n > m:
            return F.pad(grad, (0, n - m) if self._keeps_first else (n - m, 0))
        return grad

    @property
    def _keeps_first(self) -> bool:
        return self.side == "end" or self.narrowing == "keep_first"


@dataclass
class Plan:
    """What the hand-written network needs besides tensors that carry gradients.

    Args:
        layers: The residual layers.
        head: Whether a linear head follows.
        low: Weights and biases of the layers in the dtype of the products, `(K, ...)` for an ensemble; `None` to use
            the parameters themselves.
    """

    layers: tuple[Layer, ...]
    head: bool
    low: Sequence[Tensor] | None = None


def residual_network(plan: Plan, inputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> Tensor:
    """Evaluate the network on the concatenation of `inputs`.

    Args:
        plan: Shapes and low-precision weights.
        inputs: Tensors `(..., d_i)` whose widths add up to the first layer's; `(K, ..., d_i)` for an ensemble.
        parameters: Per layer weight `(o, i)`, bias `(o,)`, and (with layer norm) scale and shift `(o,)`; then weight
            and bias of the head. All with a leading K for an ensemble.

    Returns:
        `(..., out)`, float32 with a head.
    """
    return _Residual.apply(plan, len(inputs), *inputs, *parameters)  # pyright: ignore[reportReturnType]


class _Residual(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: Plan, n_inputs: int, *tensors: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs, parameters = tensors[:n_inputs], tensors[n_inputs:]
        ensemble = parameters[0].shape[0] if parameters[0].ndim == 3 else 0
        x, lead = _concatenate(inputs, ensemble, parameters[0].dtype if plan.low is None else plan.low[0].dtype)
        keep = any(ctx.needs_input_grad)
        outs, saved = [], []
        for k in range(max(ensemble, 1)):
            own, low = _member(plan, parameters, k if ensemble else None)
            out, kept = _forward(plan, x[k] if x.ndim == 3 else x, own, low, keep)
            outs.append(out)
            saved.append(kept)
        if keep:
            ctx.plan, ctx.n_inputs, ctx.ensemble, ctx.saved, ctx.parameters = (
                plan,
                n_inputs,
                ensemble,
                saved,
                parameters,
            )
            ctx.widths, ctx.lead = [t.shape[-1] for t in inputs], lead
            ctx.input_dtypes = [t.dtype for t in inputs]
        if ensemble:
            return torch.stack(outs).reshape(ensemble, *lead, -1)
        return outs[0].reshape(*lead, -1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        plan: Plan = ctx.plan
        n, ensemble, parameters = ctx.n_inputs, ctx.ensemble, ctx.parameters
        if ctx.saved is None:
            raise RuntimeError("the residual network keeps its activations for one backward pass only")
        needs = ctx.needs_input_grad[2:]
        need_weights = any(needs[n:])
        columns = _columns(ctx.widths, needs[:n])
        weight_grads: list[Tensor] = [torch.empty_like(p) for p in parameters] if need_weights else []
        input_grads: list[Tensor] = []
        grad = grad.reshape(max(ensemble, 1), -1, grad.shape[-1])
        for k in range(max(ensemble, 1)):
            own, low = _member(plan, parameters, k if ensemble else None)
            into = [g[k] for g in weight_grads] if ensemble else weight_grads
            input_grads.append(_backward(plan, grad[k], ctx.saved[k], own, low, into, columns))
        ctx.saved = None
        grads: list[Tensor | None] = [None] * n
        if columns is not None:
            dx = torch.stack(input_grads) if ensemble else input_grads[0]
            dx = dx.reshape(*((ensemble,) if ensemble else ()), *ctx.lead, -1)
            start = 0
            for i, width in enumerate(ctx.widths):
                if columns.start <= start < columns.stop and needs[i]:
                    grads[i] = dx[..., start - columns.start : start - columns.start + width].to(ctx.input_dtypes[i])
                start += width
        return (None, None, *grads, *(weight_grads if need_weights else [None] * len(parameters)))


def _member(plan: Plan, parameters: Sequence[Tensor], k: int | None) -> tuple[list[Tensor], list[Tensor]]:
    """Parameters, and weights and biases for the products, of member `k` of an ensemble (or of the one network)."""
    own = list(parameters) if k is None else [p[k] for p in parameters]
    if plan.low is not None:
        return own, list(plan.low) if k is None else [p[k] for p in plan.low]
    low, i = [], 0
    for layer in plan.layers:
        low += own[i : i + 2]
        i += 4 if layer.norm else 2
    return own, low


def _concatenate(inputs: Sequence[Tensor], ensemble: int, dtype: torch.dtype) -> tuple[Tensor, torch.Size]:
    """Concatenate to `(rows, d)`, or `(K, rows, d)` if the members of an ensemble see different inputs."""
    if not ensemble:
        lead = inputs[0].shape[:-1]
        return torch.cat([t.to(dtype) for t in inputs], -1).reshape(lead.numel(), -1), lead
    lead = inputs[0].shape[1:-1]
    if all(t.stride(0) == 0 for t in inputs):  # expanded: one input for all members
        return torch.cat([t[0].to(dtype) for t in inputs], -1).reshape(lead.numel(), -1), lead
    return torch.cat([t.to(dtype) for t in inputs], -1).reshape(ensemble, lead.numel(), -1), lead


def _columns(widths: Sequence[int], needs: Sequence[bool]) -> slice | None:
    """Smallest range of input columns that covers all inputs which need a gradient."""
    start, wanted = 0, []
    for width, need in zip(widths, needs, strict=True):
        if need:
            wanted += [start, start + width]
        start += width
    return slice(min(wanted), max(wanted)) if wanted else None


def _forward(
    plan: Plan, x: Tensor, own: list[Tensor], low: list[Tensor], keep: bool
) -> tuple[Tensor, list[tuple[Tensor, ...]]]:
    kept: list[tuple[Tensor, ...]] = []
    i = j = 0
    for layer in plan.layers:
        z = torch.addmm(low[j + 1], x, low[j].t())
        mean = rstd = z
        if layer.norm:
            y, mean, rstd = torch.native_layer_norm(z, (layer.out_features,), own[i + 2], own[i + 3], layer.eps)
            i, j = i + 4, j + 2
        else:
            y, i, j = z, i + 2, j + 2
        _relu_(y)
        if keep:
            kept.append((x, z, mean, rstd, y))
        x = layer.skip(x, y, inplace=not keep)
    if not plan.head:
        return x, kept
    hidden = x.to(own[i].dtype)
    if keep:
        kept.append((hidden,))
    return torch.addmm(own[i + 1], hidden, own[i].t()), kept


def _backward(
    plan: Plan,
    grad: Tensor,
    kept: list[tuple[Tensor, ...]],
    own: list[Tensor],
    low: list[Tensor],
    into: list[Tensor],
    columns: slice | None,
) -> Tensor:
    """Write the parameters' gradients into `into` (if any) and return the inputs' gradient for `columns`."""
    rows = None if into else _active_rows(grad)
    count = grad.shape[0]
    if rows is not None:
        grad = grad.index_select(0, rows)
    i = len(own)
    if plan.head:
        i -= 2
        if into:
            (hidden,) = kept[-1]
            torch.mm(grad.t(), hidden, out=into[i])
            torch.sum(grad, 0, out=into[i + 1])
        grad = torch.mm(grad, own[i])
    grad = grad.to(low[0].dtype)
    j = 2 * len(plan.layers)
    for index in reversed(range(len(plan.layers))):
        layer = plan.layers[index]
        x, z, mean, rstd, y = kept[index]
        if rows is not None:
            y, z = y.index_select(0, rows), z.index_select(0, rows)
            mean, rstd = (mean.index_select(0, rows), rstd.index_select(0, rows)) if layer.norm else (z, z)
        i, j = i - (4 if layer.norm else 2), j - 2
        dz = _relu_backward(grad, y)
        if layer.norm:
            dz, dscale, dshift = torch.ops.aten.native_layer_norm_backward(
                dz, z, (layer.out_features,), mean, rstd, own[i + 2], own[i + 3], (True, bool(into), bool(into))
            )
            if into:
                into[i + 2].copy_(dscale)
                into[i + 3].copy_(dshift)
        if into:
            into[i].copy_(torch.mm(dz.t(), x))
            into[i + 1].copy_(torch.sum(dz, 0))
        if index:
            grad = torch.addmm(layer.skip_adjoint(grad), dz, low[j])
        elif columns is not None:
            grad = torch.addmm(layer.skip_adjoint(grad)[:, columns], dz, low[j][:, columns])
    if rows is None or columns is None:
        return grad
    return torch.zeros(count, grad.shape[1], dtype=grad.dtype).index_copy_(0, rows, grad)


def _relu_(x: Tensor) -> None:
    """Rectify in place.

    On a CPU bfloat16 is rectified as the 16-bit integer of the same bits (negative numbers are negative integers),
    which is six times as fast. A NaN whose sign bit is set becomes 0; it still shows in the gradients, and there the
    learner looks.
    """
    if x.dtype == torch.bfloat16 and x.device.type == "cpu":
        x.view(torch.int16).clamp_min_(0)
    else:
        x.relu_()


def _relu_backward(grad: Tensor, y: Tensor) -> Tensor:
    """`grad` where the rectified `y` is positive, else 0."""
    if y.dtype == torch.bfloat16 and y.device.type == "cpu":
        bits = torch.ops.aten.threshold_backward(grad.view(torch.int16), y.view(torch.int16), 0)
        return bits.view(torch.bfloat16)
    return torch.ops.aten.threshold_backward(grad, y, 0)


def _active_rows(grad: Tensor) -> Tensor | None:
    """Rows of `(rows, out)` with a gradient, filled up to a multiple of 32; `None` if most rows have one.

    The policy's loss follows the smaller of the critics' values, so each critic receives about half of the rows.
    """
    if grad.device.type != "cpu":
        return None  # counting would wait for the device
    count = grad.shape[0]
    active = (grad != 0).any(-1)
    wanted = -(-int(active.sum()) // _ROWS) * _ROWS
    if wanted > 0.8 * count:
        return None
    return torch.argsort(active, descending=True)[:wanted]
