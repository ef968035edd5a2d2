"""The hand-written passes of residual networks on prepared memory, with the kernels of `kernels.c`.

Products of matrices fill the cache, so that every Python call between them is slow. All views, addresses and buffers
that do not change from update to update are therefore made once. A workspace is valid while the parameters stay where
they are in memory. When they move, the backend of the learner makes new plans before the next update.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from coachable.fast.crew import crew_size, cut_rows, share_out
from coachable.fast.native import Kernels, Products
from coachable.fast.passes import Layer, Member, active_rows

_FEW_OUTPUTS = 4  # of a head; beyond, products of matrices are faster than the kernels of small heads


class Workspace:
    """Buffers and prepared calls for one batch size of a plan.

    The work is cut into parts for the threads of the crew: each part is one member on all rows or on some.

    Args:
        kernels: The compiled kernels.
        layers: The residual layers.
        members: The networks' tensors, products in the kernels' dtype.
        widths: Widths of the inputs.
        rows: Number of rows of a batch.
        keep: Whether a backward pass will follow.
    """

    def __init__(
        self,
        kernels: Kernels,
        layers: Sequence[Layer],
        members: Sequence[Member],
        widths: Sequence[int],
        rows: int,
        keep: bool,
    ) -> None:
        self.rows, self.keep, self.widths = rows, keep, tuple(widths)
        width = sum(widths)
        dtype = members[0].products[0].dtype
        self._input = torch.zeros(rows, width + width % 2, dtype=dtype)[:, :width]
        self._slots = self._input.split(list(widths), -1)
        self._slices = cut_rows(rows, -(-crew_size() // len(members)))
        self._parts: list[list[_MemberSpace]] = []
        for member in members:
            # The first part writes the gradients, the others write their own, which are added.
            own = [member, *(_with_own_gradients(member) for _ in self._slices[1:])]
            inputs = [self._input[part] for part in self._slices]
            self._parts.append([_MemberSpace(kernels, layers, m, x, keep) for m, x in zip(own, inputs, strict=True)])

    def forward(self, inputs: Sequence[Tensor], out: Sequence[Tensor]) -> None:
        """Evaluate the members; see `TorchPasses.forward`."""
        for slot, value in zip(self._slots, inputs, strict=True):
            slot.copy_(value)
        share_out(
            [
                partial(space.forward, into[part])
                for parts, into in zip(self._parts, out, strict=True)
                for space, part in zip(parts, self._slices, strict=True)
            ]
        )

    def backward(self, grads: Tensor, trained: bool, add: bool, columns: slice | None) -> Tensor | None:
        """Run the backward pass of all members; see `TorchPasses.backward`."""
        step = 1 if self._parts[0][0].products() is not None else 0
        dx = None if columns is None else grads.new_empty(len(grads), self.rows, columns.stop - columns.start)

        def one(space: _MemberSpace, grad: Tensor, add: bool, into: Tensor | None) -> None:
            rows = None if trained else active_rows(grad, step)
            own = space.backward(grad, trained, add, rows, columns)
            if into is None:
                return
            if rows is None:
                into.copy_(own)
            else:
                into.zero_().index_copy_(0, rows, own.to(into.dtype))

        share_out(
            [
                partial(one, space, grads[k, part], add and i == 0, None if dx is None else dx[k, part])
                for k, parts in enumerate(self._parts)
                for i, (space, part) in enumerate(zip(parts, self._slices, strict=True))
            ]
        )
        if trained:
            for first, *others in self._parts:
                for other in others:
                    torch._foreach_add_(first.gradients, other.gradients)
        return dx if dx is None else dx.sum(0)


def _with_own_gradients(member: Member) -> Member:
    return Member(member.parameters, member.products, [torch.empty_like(grad) for grad in member.grads])


def _buffers(
    layers: Sequence[Layer], rows: int, dtype: torch.dtype, keep: bool
) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Return product, output, mean and reciprocal deviation of each layer; layers share them if `keep` is false."""

    def buffer(layer: Layer) -> Tensor:
        return torch.empty(rows, layer.out_features, dtype=dtype)

    def statistic() -> Tensor:
        return torch.empty(rows, dtype=torch.float32)

    if keep or len({layer.out_features for layer in layers}) > 1:
        return [(buffer(n), buffer(n), statistic(), statistic()) for n in layers]
    z, outs, both = buffer(layers[0]), (buffer(layers[0]), buffer(layers[0])), statistic()
    return [(z, outs[i % 2], both, both) for i in range(len(layers))]


class _MemberSpace:
    """Buffers and prepared calls for one member and its rows of the input."""

    def __init__(self, kernels: Kernels, layers: Sequence[Layer], member: Member, inputs: Tensor, keep: bool) -> None:
        self._layers, self.gradients = layers, member.grads
        rows, widest = len(inputs), max(layer.out_features for layer in layers)
        self._rows = rows
        buffers = _buffers(layers, rows, inputs.dtype, keep)
        self._scratch = torch.empty(2 * widest, dtype=torch.float32)
        if keep:
            self._flow = [torch.empty(rows, widest, dtype=inputs.dtype) for _ in range(2)]
            self._dz = torch.empty(rows, widest, dtype=inputs.dtype)
            self._dw = torch.empty(max(layer.in_features for layer in layers) * widest, dtype=inputs.dtype)
        self._layer_forward, self._layer_backward = kernels.layer_forward, kernels.layer_backward
        even = all(layer.out_features % 2 == 0 for layer in layers)
        # Torch multiplies float32 matrices as fast.
        self._own_products = kernels.products if even and inputs.dtype == torch.bfloat16 else None
        # Addresses do not keep tensors alive.
        self._own, self._low, self._buffers, self._grads = member.parameters, member.products, buffers, member.grads
        self._forward_steps: list[tuple[Any, ...]] = []
        self._backward_steps: list[tuple[Any, ...]] = []
        self._product_steps: list[tuple[Any, ...]] = []
        x, i = inputs, 0
        scratch = self._scratch.data_ptr()
        for index, layer in enumerate(layers):
            z, out, mean, rstd = buffers[index]
            bias, gamma, beta = (t.data_ptr() for t in self._own[i + 1 : i + 4])
            start, to, width = layer.skip_columns
            statistics = (mean.data_ptr(), rstd.data_ptr())
            arguments = (z.data_ptr(), bias, gamma, beta, x.data_ptr(), x.stride(0), start, to, width, layer.eps)
            arguments += (rows, layer.out_features, out.data_ptr(), *statistics, scratch)
            weight_address = self._low[i].data_ptr()
            self._forward_steps.append((x, self._low[i].t(), z, layer.in_features, weight_address, arguments))
            if keep:
                n, m = layer.in_features, layer.out_features
                # The gradient alternates between two buffers: the last layer's arrives in the first.
                flow = len(layers) - 1 - index
                here = self._flow[flow % 2].view(-1)[: rows * m].view(rows, m)
                below = self._flow[(flow + 1) % 2].view(-1)[: rows * n].view(rows, n) if index else None
                dz = self._dz.view(-1)[: rows * m].view(rows, m)
                grads = self._grads[i : i + 4]
                targets = [g.data_ptr() for g in (grads[2], grads[3], grads[1])] if grads else [None] * 3
                first = (here.data_ptr(), z.data_ptr(), bias, gamma, beta, *statistics)
                last = (m, dz.data_ptr(), *targets, scratch)
                dw = self._dw[: m * n].view(m, n)
                weight = grads[0] if grads else None
                self._backward_steps.append((layer, x, here, below, dz, dz.t(), dw, weight, self._low[i], first, last))
                factors = (dz.data_ptr(), m, x.data_ptr(), n, x.stride(0), rows)
                target = weight.data_ptr() if weight is not None else None
                addresses = dz.data_ptr(), weight_address, here.data_ptr(), None if below is None else below.data_ptr()
                self._product_steps.append((factors, target, addresses, (start, to, width)))
            x, i = out, i + 4
        self._features = x
        weight, bias = self._own[i:]
        self._head = (weight, weight.t(), bias)
        self._head_grads = self._grads[i:]
        self._head_kernels: tuple[Any, Any] | None = None
        self._head_sizes = x.shape[1], weight.shape[0]
        self._head_addresses = x.data_ptr(), weight.data_ptr(), bias.data_ptr()
        self._head_targets: list[int | None] = [g.data_ptr() for g in self._head_grads] or [None] * 2
        self._small_head = weight.shape[0] <= _FEW_OUTPUTS
        if self._small_head:
            self._head_kernels = kernels.head_forward, kernels.head_backward
            self._head_targets.append(scratch)
            return
        self._hidden = (
            x if x.dtype == torch.float32 else torch.empty(x.shape, dtype=torch.float32)
        )  # what torch's head sees
        self._head_gradient = torch.empty(x.shape, dtype=torch.float32) if keep else x

    def products(self) -> Products | None:
        return self._own_products if crew_size() > 1 or torch.get_num_threads() == 1 else None

    def forward(self, out: Tensor) -> None:
        products = self.products()
        if products is not None:
            for _, _, _, inner, address, arguments in self._forward_steps:
                products.dense_forward(inner, address, *arguments)
        else:
            for x, weight, z, _, _, arguments in self._forward_steps:
                torch.mm(x, weight, out=z)
                self._layer_forward(*arguments)
        if not self._small_head:  # the backward pass follows this choice
            self._head_kernels = products and (products.wide_head_forward, products.wide_head_backward)
        if self._head_kernels is not None:
            self._head_kernels[0](*self._head_addresses, self._rows, *self._head_sizes, out.data_ptr())
        else:
            if self._hidden is not self._features:
                self._hidden.copy_(self._features)
            torch.addmm(self._head[2], self._hidden, self._head[1], out=out)

    def backward(self, grad: Tensor, trained: bool, add: bool, rows: Tensor | None, columns: slice | None) -> Tensor:
        if rows is not None:
            grad = grad.index_select(0, rows)
        count, top = grad.shape[0], self._backward_steps[-1][2]
        if self._head_kernels is not None:
            grad = grad.contiguous()
            arguments = (grad.data_ptr(), *self._head_addresses[:2], count, *self._head_sizes, trained, add)
            self._head_kernels[1](*arguments, top.data_ptr(), *self._head_targets)
        else:
            if trained:
                weight, bias = self._head_grads
                if add:
                    weight.addmm_(grad.t(), self._hidden)
                    bias.add_(grad.sum(0))
                else:
                    torch.mm(grad.t(), self._hidden, out=weight)
                    torch.sum(grad, 0, out=bias)
            top[:count].copy_(torch.mm(grad, self._head[0], out=self._head_gradient[:count]))
        kernel, products = self._layer_backward, self.products()
        address = None if rows is None else rows.data_ptr()
        for index in reversed(range(len(self._layers))):
            layer, x, here, below, dz, dz_t, dw, into, weight, first, last = self._backward_steps[index]
            kernel(*first, address, count, trained, add, *last)
            if products is not None:
                factors, target, (dz_at, weight_at, here_at, below_at), (start, *skip) = self._product_steps[index]
                if trained:
                    products.weight_gradient(*factors, add, target)
                n, m = layer.in_features, layer.out_features
                if index:
                    products.dense_backward(dz_at, count, m, weight_at, n, n, here_at, start, *skip, below_at)
                elif columns is not None:
                    first_column, width = columns.start, columns.stop - columns.start
                    grad = torch.empty(count, width, dtype=dz.dtype)
                    factor = weight_at + first_column * dz.itemsize, n, width
                    place = here_at, start - first_column, *skip, grad.data_ptr()
                    products.dense_backward(dz_at, count, m, *factor, *place)
                continue
            if trained:
                if add:
                    into.add_(torch.mm(dz_t, x))
                elif into.dtype == dz_t.dtype:
                    torch.mm(dz_t, x, out=into)
                else:
                    into.copy_(torch.mm(dz_t, x, out=dw))
            if rows is not None:
                dz, here = dz[:count], here[:count]
            if below is not None:
                below = below if rows is None else below[:count]
                torch.addmm(layer.skip_adjoint(here), dz, weight, out=below)
            elif columns is not None:
                return layer.skip_adjoint(here)[:, columns] + torch.mm(dz, weight[:, columns])
        return grad
