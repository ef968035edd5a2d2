"""Forward and backward of a residual network by hand, for one network or an ensemble of equal ones.

The same numbers as `ResidualMLP` gives layer by layer, with less work: no autograd node per operation, weights that
were cast to bfloat16 once per update instead of at every use, gradients written to where the optimiser reads them, and
no gradient that nobody asked for. The learner uses it during its updates, on CPUs.

Numerics at bfloat16: products accumulate in float32; layer-norm statistics, heads, parameters and their gradients are
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

    @property
    def tensors(self) -> int:
        """Number of parameters: weight, bias, and the layer norm's scale and shift."""
        return 4 if self.norm else 2

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


@dataclass(frozen=True)
class Member:
    """Tensors of one network, none of which autograd knows.

    Args:
        parameters: Per layer weight `(o, i)`, bias `(o,)`, and with layer norm scale and shift `(o,)`; then weight and
            bias of the head.
        products: The same list in the dtype of the matrix products (only weights and biases of the layers are read).
        grads: Where the parameters' gradients go, or empty if nobody wants them.
    """

    parameters: list[Tensor]
    products: list[Tensor]
    grads: list[Tensor]


class Plan:
    """How to evaluate a residual network, or an ensemble of them, with the hand-written passes.

    Args:
        layers: The residual layers.
        head: Whether a linear head follows.
        members: The networks' tensors.
        stacked: Whether the output has a leading dimension for the members.
    """

    def __init__(self, layers: Sequence[Layer], head: bool, members: Sequence[Member], stacked: bool) -> None:
        self.layers = tuple(layers)
        self.head = head
        self.members = tuple(members)
        self.stacked = stacked
        # Stands for the parameters in autograd's graph, so that an output without other trained inputs has a gradient.
        self.anchor = torch.zeros((), requires_grad=True) if members[0].grads else None
        self.written = False

    def begin(self) -> None:
        """Forget the gradients: the next backward pass overwrites them, further ones add to them."""
        self.written = False

    def finish(self) -> None:
        """Make the gradients zero if no backward pass came by."""
        if not self.written:
            for member in self.members:
                for grad in member.grads:
                    grad.zero_()


def residual_network(plan: Plan, inputs: Sequence[Tensor]) -> Tensor:
    """Evaluate a network, or each member of an ensemble, on the concatenation of `inputs`.

    Args:
        plan: The network.
        inputs: Tensors `(..., d_i)` whose widths add up to the first layer's.

    Returns:
        `(..., out)`, or `(K, ..., out)` for an ensemble; float32 with a head.
    """
    return _Residual.apply(plan, plan.anchor if torch.is_grad_enabled() else None, *inputs)  # pyright: ignore[reportReturnType]


class _Residual(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: Plan, anchor: Tensor | None, *inputs: Tensor) -> Tensor:  # pyright: ignore
        lead = inputs[0].shape[:-1]
        dtype = plan.members[0].products[0].dtype
        x = torch.cat([t.to(dtype) for t in inputs], -1).flatten(0, -2)
        keep = any(ctx.needs_input_grad)
        outs, saved = [], []
        for member in plan.members:
            out, kept = _forward(plan, x, member, keep)
            outs.append(out)
            saved.append(kept)
        if keep:
            ctx.plan, ctx.saved, ctx.lead = plan, saved, lead
            ctx.facts = [(t.shape[-1], t.dtype) for t in inputs]
        if plan.stacked:
            return torch.stack(outs).view(len(outs), *lead, -1)
        return outs[0].view(*lead, -1)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        plan: Plan = ctx.plan
        if ctx.saved is None:
            raise RuntimeError("the residual network keeps its activations for one backward pass only")
        _, trained, *needs = ctx.needs_input_grad
        columns = _columns([width for width, _ in ctx.facts], needs)
        count = ctx.lead.numel()
        grad = grad.reshape(len(plan.members), count, grad.shape[-1])
        dx: Tensor | None = None
        for k, member in enumerate(plan.members):
            rows = None if trained else _active_rows(grad[k])
            own = _backward(plan, grad[k], ctx.saved[k], member, trained, rows, columns)
            if columns is None:
                continue
            if dx is None:
                if rows is None:
                    dx = own
                    continue
                dx = own.new_zeros(count, own.shape[1])
            dx = dx.add_(own) if rows is None else dx.index_add_(0, rows, own)
        ctx.saved = None
        plan.written = plan.written or trained
        grads: list[Tensor | None] = [None] * len(needs)
        if columns is not None and dx is not None:
            start = -columns.start
            for i, (width, dtype) in enumerate(ctx.facts):
                if needs[i]:
                    grads[i] = dx[:, start : start + width].to(dtype).view(*ctx.lead, width)
                start += width
        return (None, torch.zeros(()) if trained else None, *grads)


def _columns(widths: Sequence[int], needs: Sequence[bool]) -> slice | None:
    """Smallest range of input columns that covers all inputs which need a gradient."""
    start, wanted = 0, []
    for width, need in zip(widths, needs, strict=True):
        if need:
            wanted += [start, start + width]
        start += width
    return slice(min(wanted), max(wanted)) if wanted else None


def _forward(plan: Plan, x: Tensor, member: Member, keep: bool) -> tuple[Tensor, list[tuple[Tensor, ...]]]:
    kept: list[tuple[Tensor, ...]] = []
    own, low, i = member.parameters, member.products, 0
    for layer in plan.layers:
        z = torch.addmm(low[i + 1], x, low[i].t())
        y, mean, rstd = z, z, z
        if layer.norm:
            y, mean, rstd = torch.native_layer_norm(z, (layer.out_features,), own[i + 2], own[i + 3], layer.eps)
        _relu_(y)
        if keep:
            kept.append((x, z, mean, rstd, y))
        x = layer.skip(x, y, inplace=not keep)
        i += layer.tensors
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
    member: Member,
    trained: bool,
    rows: Tensor | None,
    columns: slice | None,
) -> Tensor:
    """Write the parameters' gradients if `trained`, and return the inputs' gradient for `columns` of the `rows`."""
    own, low, into, add = member.parameters, member.products, member.grads, plan.written
    i = len(own)
    if rows is not None:
        grad = grad.index_select(0, rows)
    if plan.head:
        i -= 2
        if trained:
            _write(into[i], torch.mm(grad.t(), kept[-1][0]), add)
            _write(into[i + 1], grad.sum(0), add)
        grad = torch.mm(grad, own[i])
    grad = grad.to(low[0].dtype)
    for index in reversed(range(len(plan.layers))):
        layer = plan.layers[index]
        i -= layer.tensors
        x, z, mean, rstd, y = kept[index]
        if rows is not None:
            y, z = y.index_select(0, rows), z.index_select(0, rows)
            mean, rstd = (mean.index_select(0, rows), rstd.index_select(0, rows)) if layer.norm else (z, z)
        dz = _relu_backward(grad, y)
        if layer.norm:
            dz, dscale, dshift = torch.ops.aten.native_layer_norm_backward(
                dz, z, (layer.out_features,), mean, rstd, own[i + 2], own[i + 3], (True, trained, trained)
            )
            if trained:
                _write(into[i + 2], dscale, add)
                _write(into[i + 3], dshift, add)
        if trained:
            _write(into[i], torch.mm(dz.t(), x), add)
            _write(into[i + 1], dz.sum(0), add)
        if index:
            grad = torch.addmm(layer.skip_adjoint(grad), dz, low[i])
        elif columns is not None:
            grad = layer.skip_adjoint(grad)[:, columns] + torch.mm(dz, low[i][:, columns])
    return grad


def _write(into: Tensor, value: Tensor, add: bool) -> None:
    if add:
        into.add_(value)
    else:
        into.copy_(value)


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
    count = grad.shape[0]
    active = (grad != 0).any(-1)
    wanted = -(-int(active.sum()) // _ROWS) * _ROWS
    if wanted > 0.8 * count:
        return None
    return torch.argsort(active, descending=True)[:wanted]
