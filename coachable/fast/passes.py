"""Forward and backward of residual layers by hand, in torch's operations."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

_TENSORS = 4  # of a layer: weight, bias, and the layer norm's scale and shift
_ROWS = 32  # granularity of the row-sparse backward with oneDNN, whose cache of kernels few distinct sizes keep small


@dataclass(frozen=True)
class Layer:
    """Shapes of one residual layer."""

    in_features: int
    out_features: int
    side: str
    eps: float

    @property
    def skip_columns(self) -> tuple[int, int, int]:
        """Return where `fit` reads in the input, where it adds to the output, and how many columns."""
        n, m = self.in_features, self.out_features
        if n <= m:
            return 0, 0 if self.side == "end" else m - n, n
        return 0 if self.side == "end" else n - m, 0, m

    def skip(self, x: Tensor, hidden: Tensor, *, inplace: bool) -> Tensor:
        """Return `hidden + fit(x)`; `hidden` may be overwritten if `inplace`.

        Args:
            x: Input of the layer (rows, in_features).
            hidden: Output before the residual connection (rows, out_features).
            inplace: Whether `hidden` may be overwritten.

        Returns:
            (rows, out_features).
        """
        start, to, width = self.skip_columns
        if width == self.out_features:
            x = x[:, start : start + width]
            return hidden.add_(x) if inplace else hidden + x
        out = hidden if inplace else hidden.clone()
        out[:, to : to + width].add_(x)
        return out

    def skip_adjoint(self, grad: Tensor) -> Tensor:
        """Return the gradient (rows, in_features) of `fit(x)` with respect to x.

        Args:
            grad: Gradient of the output (rows, out_features).
        """
        start, to, width = self.skip_columns
        missing = self.in_features - width
        return F.pad(grad, (start, missing - start)) if missing else grad[:, to : to + width]


@dataclass(frozen=True)
class Member:
    """Tensors of one network, without autograd.

    Args:
        parameters: Per layer weight `(o, i)`, bias `(o,)`, and scale and shift `(o,)` of the layer norm; then weight
            and bias of the head.
        products: The same list in the dtype of the matrix products (only weights and biases of the layers are read).
        grads: Where the parameters' gradients go; empty if they are not needed.
    """

    parameters: list[Tensor]
    products: list[Tensor]
    grads: list[Tensor]


class TorchPasses:
    """One evaluation of the members of a plan, and its backward pass.

    Args:
        layers: The residual layers.
        members: The networks' tensors.
        keep: Whether a backward pass will follow.
    """

    def __init__(self, layers: Sequence[Layer], members: Sequence[Member], keep: bool) -> None:
        self._layers, self._members, self._keep = layers, members, keep
        self._kept: list[list[tuple[Tensor, ...]]] = []

    def forward(self, inputs: Sequence[Tensor], out: Sequence[Tensor]) -> None:
        """Evaluate the members.

        Args:
            inputs: Parts of the common input, (rows, d_i) each.
            out: Outputs to write, (rows, o) for each member.
        """
        dtype = self._members[0].products[0].dtype
        x = torch.cat([t.to(dtype) for t in inputs], -1)
        self._kept = [self._forward(x, member, into) for member, into in zip(self._members, out, strict=True)]

    def backward(self, grads: Tensor, trained: bool, add: bool, columns: slice | None) -> Tensor | None:
        """Run the backward pass of all members.

        Args:
            grads: Gradients of their outputs, `(K, rows, o)`.
            trained: Whether to write their parameters' gradients.
            add: Add them to those present instead of replacing them.
            columns: Columns of the concatenated inputs whose gradient is wanted, `None` for none.

        Returns:
            Gradient of the inputs, summed over the members, `(rows, columns)`; `None` without `columns`.
        """
        total: Tensor | None = None
        for k, grad in enumerate(grads):
            rows = None if trained else active_rows(grad, 0)
            own = self._backward(k, grad, trained, add, rows, columns)
            if columns is None:
                continue
            if rows is not None:
                own = own.new_zeros(len(grad), own.shape[1]).index_copy_(0, rows, own)
            total = own if total is None else total.add_(own)
        return total

    def _backward(
        self, k: int, grad: Tensor, trained: bool, add: bool, rows: Tensor | None, columns: slice | None
    ) -> Tensor:
        """Return the gradient of the inputs of member `k` in `rows`; meaningless without `columns`."""
        member, kept = self._members[k], self._kept[k]
        own, low, into = member.parameters, member.products, member.grads
        if rows is not None:
            grad = grad.index_select(0, rows)
        if trained:
            _write(into[-2], torch.mm(grad.t(), kept[-1][0]), add)
            _write(into[-1], grad.sum(0), add)
        grad = torch.mm(grad, own[-2]).to(low[0].dtype)
        for index in reversed(range(len(self._layers))):
            layer = self._layers[index]
            i = _TENSORS * index
            x, z, mean, rstd, y = kept[index]
            if rows is not None:
                y, z = y.index_select(0, rows), z.index_select(0, rows)
                mean, rstd = mean.index_select(0, rows), rstd.index_select(0, rows)
            dz, dscale, dshift = torch.ops.aten.native_layer_norm_backward(
                _relu_backward(grad, y),
                z,
                (layer.out_features,),
                mean,
                rstd,
                own[i + 2],
                own[i + 3],
                (True, trained, trained),
            )
            if trained:
                _write(into[i], torch.mm(dz.t(), x), add)
                _write(into[i + 1], dz.sum(0), add)
                _write(into[i + 2], dscale, add)
                _write(into[i + 3], dshift, add)
            if index:
                grad = torch.addmm(layer.skip_adjoint(grad), dz, low[i])
            elif columns is not None:
                grad = layer.skip_adjoint(grad)[:, columns] + torch.mm(dz, low[i][:, columns])
        return grad

    def _forward(self, x: Tensor, member: Member, into: Tensor) -> list[tuple[Tensor, ...]]:
        kept: list[tuple[Tensor, ...]] = []
        own, low = member.parameters, member.products
        for index, layer in enumerate(self._layers):
            i = _TENSORS * index
            z = torch.addmm(low[i + 1], x, low[i].t())
            y, mean, rstd = torch.native_layer_norm(z, (layer.out_features,), own[i + 2], own[i + 3], layer.eps)
            _relu_(y)
            if self._keep:
                kept.append((x, z, mean, rstd, y))
            x = layer.skip(x, y, inplace=not self._keep)
        hidden = x.to(own[-2].dtype)
        kept.append((hidden,))
        torch.addmm(own[-1], hidden, own[-2].t(), out=into)
        return kept


def active_rows(grad: Tensor, step: int) -> Tensor | None:
    """Return the rows of `(rows, out)` with a gradient, filled up to a multiple of `step`; `None` if most have one.

    The policy's loss uses the smaller of the critics' values, so each critic has a gradient in about half of the rows.

    Args:
        grad: The gradient.
        step: 0 for the granularity of torch's products.
    """
    step = step or _ROWS
    count = grad.shape[0]
    active = (grad != 0).any(-1)
    rows = active.nonzero().squeeze(-1)
    wanted = -(-len(rows) // step) * step
    if wanted > 0.8 * count:
        return None
    return rows if wanted == len(rows) else torch.argsort(active, descending=True)[:wanted]


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
