"""Residual networks with forward and backward by hand, for one network or an ensemble of equal ones.

They compute the same numbers as `ResidualMLP` with less work: there is no autograd node per operation, weights are cast
to bfloat16 once per update instead of at every use, gradients go to where the optimiser reads them, and only the
gradients that are needed are computed.

Numerics at bfloat16: products accumulate in float32; layer-norm statistics, heads, parameters and their gradients are
float32; activations between the layers are bfloat16.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from coachable.fast.crew import crew_size
from coachable.fast.native import KERNEL_THREADS, load_kernels
from coachable.fast.passes import Layer, Member, TorchPasses
from coachable.fast.workspace import Workspace

_SIZES = 4  # batch sizes for which memory is kept ready


class Plan:
    """How to evaluate a residual network, or an ensemble of them, with the hand-written passes.

    Args:
        layers: The residual layers.
        members: The networks' tensors.
        stacked: Whether the output has a leading dimension for the members.
    """

    def __init__(self, layers: Sequence[Layer], members: Sequence[Member], stacked: bool) -> None:
        self.layers = tuple(layers)
        self.members = tuple(members)
        self.stacked = stacked
        # Represents the parameters in autograd's graph, so that outputs require a gradient even if no input does.
        self.anchor = torch.zeros((), requires_grad=True) if members[0].grads else None
        self.written = False
        self._spaces: dict[tuple[int, ...], list[Workspace]] = {}
        own = members[0].parameters[0]
        suits = own.device.type == "cpu" and own.dtype == torch.float32
        self._kernel_threads = KERNEL_THREADS if suits else 0

    @property
    def out_features(self) -> int:
        """Width of the output."""
        return self.members[0].parameters[-1].shape[0]

    def begin(self) -> None:
        """Start new gradients: the next backward pass overwrites the old ones, and later passes add to it."""
        self.written = False

    def finish(self) -> None:
        """Set the gradients to zero if there was no backward pass since :meth:`begin`."""
        if not self.written:
            for member in self.members:
                for grad in member.grads:
                    grad.zero_()

    def acquire(self, widths: Sequence[int], rows: int, keep: bool) -> Workspace | TorchPasses:
        """Return what evaluates the plan, and back if `keep`: memory for compiled kernels, or torch's operations."""
        kernels = load_kernels().get(self.members[0].products[0].dtype)
        if kernels is None or torch.get_num_threads() > self._kernel_threads:
            return TorchPasses(self.layers, self.members, keep)
        key = (crew_size(), rows, keep, *widths)
        if key not in self._spaces and len(self._spaces) >= _SIZES:
            del self._spaces[next(iter(self._spaces))]
        free = self._spaces.setdefault(key, [])
        return free.pop() if free else Workspace(kernels, self.layers, self.members, widths, rows, keep)

    def release(self, passes: Workspace | TorchPasses) -> None:
        """Take prepared memory back for the next evaluation of the same size."""
        if isinstance(passes, Workspace):
            free = self._spaces.get((crew_size(), passes.rows, passes.keep, *passes.widths))
            if free is not None:
                free.append(passes)


def residual_network(plan: Plan, inputs: Sequence[Tensor]) -> Tensor:
    """Evaluate a network, or each member of an ensemble, on the concatenation of `inputs`.

    Args:
        plan: The network.
        inputs: Tensors `(..., d_i)` whose widths add up to the first layer's.

    Returns:
        `(..., out)`, or `(K, ..., out)` for an ensemble; float32.
    """
    return _Residual.apply(plan, plan.anchor if torch.is_grad_enabled() else None, *inputs)  # pyright: ignore[reportReturnType]


class _Residual(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: Plan, anchor: Tensor | None, *inputs: Tensor) -> Tensor:  # pyright: ignore
        lead, widths = inputs[0].shape[:-1], [t.shape[-1] for t in inputs]
        rows, keep = lead.numel(), any(ctx.needs_input_grad)
        passes = plan.acquire(widths, rows, keep)
        dtype = plan.members[0].parameters[-1].dtype
        out = torch.empty(len(plan.members), rows, plan.out_features, dtype=dtype, device=inputs[0].device)
        passes.forward([t.reshape(rows, -1) for t in inputs], out.unbind())
        if keep:
            ctx.plan, ctx.passes, ctx.lead = plan, passes, lead
            ctx.widths, ctx.dtypes = widths, [t.dtype for t in inputs]
        else:
            plan.release(passes)
        return out.view((len(plan.members), *lead, -1) if plan.stacked else (*lead, -1))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        plan, passes, count = ctx.plan, ctx.passes, ctx.lead.numel()
        if passes is None:
            raise RuntimeError("the residual network keeps its activations for one backward pass only")
        _, trained, *needs = ctx.needs_input_grad
        columns = _columns(ctx.widths, needs)
        grad = grad.reshape(len(plan.members), count, grad.shape[-1])
        dx = passes.backward(grad, trained, plan.written, columns)
        ctx.passes = None
        plan.release(passes)
        plan.written = plan.written or trained
        grads: list[Tensor | None] = [None] * len(needs)
        if columns is not None and dx is not None:
            start = -columns.start
            for i, (width, dtype) in enumerate(zip(ctx.widths, ctx.dtypes, strict=True)):
                if needs[i]:
                    grads[i] = dx[:, start : start + width].to(dtype).view(*ctx.lead, width)
                start += width
        return (None, torch.zeros(()) if trained else None, *grads)


def _columns(widths: Sequence[int], needs: Sequence[bool]) -> slice | None:
    """Return the smallest range of input columns that covers all inputs which need a gradient."""
    start, wanted = 0, []
    for width, need in zip(widths, needs, strict=True):
        if need:
            wanted += [start, start + width]
        start += width
    return slice(min(wanted), max(wanted)) if wanted else None
