"""The hand-written passes of residual networks on prepared memory, with the kernels of `kernels.c`.

Between two products of matrices that fill the cache, every Python call is a cold one; so all views, buffers and the
addresses of these buffers, which nobody else has, are prepared once. Addresses of parameters and gradients are taken at
each call: whoever shares a network with other processes moves them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from coachable.networks.memory import Arena
from coachable.networks.native import Kernels, Products
from coachable.networks.passes import Layer, Member

_FEW_OUTPUTS = 4  # of a head; beyond, products of matrices are faster than the kernels of small heads


class Workspace:
    """Buffers and prepared calls for one batch size of a plan.

    Args:
        kernels: The compiled kernels.
        layers: The residual layers, all with layer norm.
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
        self._arena, self._dtype = Arena(), members[0].products[0].dtype
        widest = max(layer.out_features for layer in layers)
        self._scratch = self._arena.empty(2 * widest)
        width = sum(widths)
        self._input = self._arena.zeros(rows, width + width % 2, dtype=self._dtype)[:, :width]
        self._slots = self._input.split(list(widths), -1)
        if keep:
            self._flow = [self._arena.empty(rows, widest, dtype=self._dtype) for _ in range(2)]
            self._dz = self._arena.empty(rows, widest, dtype=self._dtype)
            self._dw = self._arena.empty(max(layer.in_features for layer in layers) * widest, dtype=self._dtype)
        shared = None if keep else self._buffers(layers)
        self._members = [
            _MemberSpace(self, kernels, layers, member, shared or self._buffers(layers)) for member in members
        ]

    def _buffers(self, layers: Sequence[Layer]) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Product, output, mean and reciprocal deviation of each layer; little memory if nothing is kept."""

        def buffer(layer: Layer) -> Tensor:
            return self._arena.empty(self.rows, layer.out_features, dtype=self._dtype)

        if self.keep or len({layer.out_features for layer in layers}) > 1:
            return [(buffer(n), buffer(n), self._arena.empty(self.rows), self._arena.empty(self.rows)) for n in layers]
        z, outs, statistic = buffer(layers[0]), (buffer(layers[0]), buffer(layers[0])), self._arena.empty(self.rows)
        return [(z, outs[i % 2], statistic, statistic) for i in range(len(layers))]

    @property
    def own_products(self) -> bool:
        """Whether the products are those of the kernels now."""
        return self._members[0].products() is not None

    def forward(self, inputs: Sequence[Tensor], out: Sequence[Tensor]) -> None:
        """Evaluate the members on `inputs` `(rows, d_i)` into `out`, each `(rows, o)`."""
        for slot, value in zip(self._slots, inputs, strict=True):
            slot.copy_(value)
        for member, into in zip(self._members, out, strict=True):
            member.forward(into)

    def backward(
        self, k: int, grad: Tensor, trained: bool, add: bool, rows: Tensor | None, columns: slice | None
    ) -> Tensor:
        """Backward pass of member `k`, see `TorchPasses.backward`."""
        return self._members[k].backward(grad, trained, add, rows, columns)


class _MemberSpace:
    def __init__(
        self,
        space: Workspace,
        kernels: Kernels,
        layers: Sequence[Layer],
        member: Member,
        buffers: Sequence[tuple[Tensor, Tensor, Tensor, Tensor]],
    ) -> None:
        self._space = space
        self._layer_forward, self._layer_backward = kernels.layer_forward, kernels.layer_backward
        even = all(layer.out_features % 2 == 0 for layer in layers)
        self._own_products = kernels.products if even else None
        parameters, grads = member.parameters, member.grads
        self._layers: list[_LayerSpace] = []
        x, i = space._input, 0
        for index, layer in enumerate(layers):
            below = len(layers) - 1 - index
            own = member.products[i], *parameters[i + 1 : i + 4]
            self._layers.append(_LayerSpace(space, layer, x, own, grads[i : i + 4], buffers[index], below))
            x, i = buffers[index][1], i + layer.tensors
        self._features, self._features_at, self._scratch_at = x, x.data_ptr(), space._scratch.data_ptr()
        self._head = (parameters[i], parameters[i + 1]) if i < len(parameters) else None
        self._head_grads = grads[i:]
        self._head_kernels: tuple[Any, Any] | None = None
        if self._head is None:
            return
        outputs = self._head[0].shape[0]
        self._head_sizes = x.shape[1], outputs
        self._small_head = outputs <= _FEW_OUTPUTS
        if self._small_head:
            self._head_kernels = kernels.head_forward, kernels.head_backward
            return
        self._hidden = x if x.dtype == torch.float32 else space._arena.empty(*x.shape)  # what torch's head sees
        self._head_gradient = space._arena.empty(*x.shape) if space.keep else x

    def products(self) -> Products | None:
        return self._own_products if torch.get_num_threads() == 1 else None

    def forward(self, out: Tensor) -> None:
        products = self.products()
        for layer in self._layers:
            own, (z, *rest) = [tensor.data_ptr() for tensor in layer.norm], layer.forward_arguments
            if products is not None:
                products.dense_forward(layer.in_features, layer.low.data_ptr(), z, *own, *rest)
            else:
                torch.mm(layer.x, layer.low.t(), out=layer.z)
                self._layer_forward(z, *own, *rest)
        if self._head is None:
            out.copy_(self._features)
            return
        if not self._small_head:  # the backward pass follows this choice
            self._head_kernels = products and (products.wide_head_forward, products.wide_head_backward)
        weight, bias = self._head
        if self._head_kernels is not None:
            addresses = self._features_at, weight.data_ptr(), bias.data_ptr()
            self._head_kernels[0](*addresses, self._space.rows, *self._head_sizes, out.data_ptr())
        else:
            if self._hidden is not self._features:
                self._hidden.copy_(self._features)
            torch.addmm(bias, self._hidden, weight.t(), out=out)

    def backward(self, grad: Tensor, trained: bool, add: bool, rows: Tensor | None, columns: slice | None) -> Tensor:
        if rows is not None:
            grad = grad.index_select(0, rows)
        count, top = grad.shape[0], self._layers[-1].here
        if self._head is None:
            top[:count].copy_(grad)
        else:
            self._head_backward(self._head[0], grad, trained, add, top)
        kernel, products = self._layer_backward, self.products()
        index = None if rows is None else rows.data_ptr()
        for layer in reversed(self._layers):
            own = [tensor.data_ptr() for tensor in layer.norm]
            targets = [grad.data_ptr() for grad in layer.norm_grads] if trained else (None, None, None)
            here, z, dz, *statistics = layer.backward_addresses
            numbers = index, count, trained, add, layer.out_features
            kernel(here, z, *own, *statistics, *numbers, dz, *targets, self._scratch_at)
            if products is not None:
                if trained:
                    products.weight_gradient(*layer.factors, add, layer.weight_grad.data_ptr())
                if layer.below is not None:
                    layer.input_gradient(products, count, 0, layer.in_features, layer.below_at)
                elif columns is not None:
                    width = columns.stop - columns.start
                    grad = torch.empty(count, width, dtype=layer.dz.dtype)
                    layer.input_gradient(products, count, columns.start, width, grad.data_ptr())
                continue
            if trained:
                layer.weight_gradient_of_torch(add)
            dz, here, weight = layer.dz[:count], layer.here[:count], layer.low
            if layer.below is not None:
                torch.addmm(layer.shape.skip_adjoint(here), dz, weight, out=layer.below[:count])
            elif columns is not None:
                return layer.shape.skip_adjoint(here)[:, columns] + torch.mm(dz, weight[:, columns])
        return grad

    def _head_backward(self, weight: Tensor, grad: Tensor, trained: bool, add: bool, top: Tensor) -> None:
        count = grad.shape[0]
        if self._head_kernels is not None:
            grad = grad.contiguous()
            first = grad.data_ptr(), self._features_at, weight.data_ptr()
            targets = [into.data_ptr() for into in self._head_grads] if trained else (None, None)
            scratch = (self._scratch_at,) if self._small_head else ()
            self._head_kernels[1](*first, count, *self._head_sizes, trained, add, top.data_ptr(), *targets, *scratch)
            return
        if trained:
            into, bias = self._head_grads
            if add:
                into.addmm_(grad.t(), self._hidden)
                bias.add_(grad.sum(0))
            else:
                torch.mm(grad.t(), self._hidden, out=into)
                torch.sum(grad, 0, out=bias)
        top[:count].copy_(torch.mm(grad, weight, out=self._head_gradient[:count]))


class _LayerSpace:
    """Tensors and sizes that the kernels of one layer take.

    Args:
        space: Memory that all layers share.
        shape: The layer.
        x: Its input.
        own: Weight in the dtype of the products, bias, and the layer norm's scale and shift.
        grads: Where the gradients of weight, bias, scale and shift go, or nothing.
        buffers: Product, output, mean and reciprocal deviation.
        flow: Number of layers above.
    """

    def __init__(
        self,
        space: Workspace,
        shape: Layer,
        x: Tensor,
        own: Sequence[Tensor],
        grads: Sequence[Tensor],
        buffers: tuple[Tensor, Tensor, Tensor, Tensor],
        flow: int,
    ) -> None:
        rows, n, m = space.rows, shape.in_features, shape.out_features
        self.low, *self.norm = own
        self.z, out, mean, rstd = buffers
        self.x, self.shape, self.in_features, self.out_features = x, shape, n, m
        z_at, x_at, stride = self.z.data_ptr(), x.data_ptr(), x.stride(0)
        self._skip = shape.skip_columns
        statistics = mean.data_ptr(), rstd.data_ptr()
        last = out.data_ptr(), *statistics, space._scratch.data_ptr()
        self.forward_arguments = (z_at, x_at, stride, *self._skip, shape.eps, rows, m, *last)
        if not space.keep:
            return
        # The gradient alternates between two buffers: the last layer's arrives in the first.
        self.here = _corner(space._flow[flow % 2], rows, m)
        self.below = _corner(space._flow[(flow + 1) % 2], rows, n) if x is not space._input else None
        self.below_at = 0 if self.below is None else self.below.data_ptr()
        self.dz, self._dw = _corner(space._dz, rows, m), _corner(space._dw, m, n)
        self._here_at, self._dz_at = self.here.data_ptr(), self.dz.data_ptr()
        self.backward_addresses = (self._here_at, z_at, self._dz_at, *statistics)
        self.norm_grads = (grads[2], grads[3], grads[1]) if grads else ()
        self.weight_grad = grads[0] if grads else self._dw
        self.factors = (self._dz_at, m, x_at, n, stride, rows)

    def weight_gradient_of_torch(self, add: bool) -> None:
        """Gradient of the weight by torch's product."""
        into = self.weight_grad
        if add:
            into.add_(torch.mm(self.dz.t(), self.x))
        elif into.dtype == self.dz.dtype:
            torch.mm(self.dz.t(), self.x, out=into)
        else:
            into.copy_(torch.mm(self.dz.t(), self.x, out=self._dw))

    def input_gradient(self, products: Products, count: int, first: int, width: int, into: int) -> None:
        """Gradient of `width` columns of the input from column `first`, by the kernels, to the address `into`."""
        start, *skip = self._skip
        weight = self.low.data_ptr() + first * self.low.itemsize
        place = self._here_at, start - first, *skip, into
        products.dense_backward(self._dz_at, count, self.out_features, weight, self.in_features, width, *place)


def _corner(memory: Tensor, rows: int, columns: int) -> Tensor:
    """The beginning of `memory` as a matrix."""
    return memory.view(-1)[: rows * columns].view(rows, columns)
