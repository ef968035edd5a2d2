"""Adam in one pass over memory, which also renews the rounded copies and moves the target network."""

import ctypes
import itertools
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.graph import increment_version

from coachable.fast.crew import crew_size, share_out
from coachable.fast.flat import FlatBuffers
from coachable.fast.native import KERNEL_THREADS, load_kernels


class FlatAdam(torch.optim.Adam):
    """Adam for a network of the hand-written passes.

    It gives the same numbers as `torch.optim.Adam` and keeps the same state, so that a state dict of either loads into
    the other. Weight decay, AMSGrad and maximisation are not offered.

    Args:
        params: The trained parameters.
        flat: Their buffers: gradients, and rounded copies, which every step renews.
        target: The target network's buffers, or `None`.
        tau: Polyak rate by which the target moves after every step.
        lr: Learning rate.
        eps: Adam's epsilon.
    """

    def __init__(
        self,
        params: list[nn.Parameter],
        flat: FlatBuffers,
        target: FlatBuffers | None,
        tau: float,
        *,
        lr: float,
        eps: float,
    ) -> None:
        super().__init__(params, lr=lr, eps=eps, fused=True)
        self._flat, self._target, self._tau = flat, target, tau
        self._used: tuple[list[Any], list[Any]] = [], []
        self._complete_state()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state of this class or of `torch.optim.Adam`."""
        super().load_state_dict(state_dict)
        self._complete_state()

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Leave the gradients alone, because every backward pass writes them anew."""

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Step on the gradients in the buffers, renew the rounded copies, and move the target.

        Raises:
            ValueError: If a parameter group asks for weight decay, AMSGrad or maximisation.
        """
        (group,) = self.param_groups
        if asked := [name for name in ("weight_decay", "amsgrad", "maximize") if group[name]]:
            raise ValueError(f"{asked[0]}={group[asked[0]]}: the accelerated optimiser has none; expected fast=off")
        (beta1, beta2), rate, eps = group["betas"], group["lr"], group["eps"]
        flat, target, tensors = self._flat, self._target, self._flat.tensors
        states = [self.state[parameter] for parameter in flat.originals]
        steps, first, second = ([state[name] for state in states] for name in ("step", "exp_avg", "exp_avg_sq"))
        single = tensors[0].dtype == torch.float32
        if single and torch.get_num_threads() <= KERNEL_THREADS and (kernels := load_kernels()):
            taken = steps[0].item() + 1.0
            rate, root = rate / (1.0 - beta1**taken), (1.0 - beta2**taken) ** -0.5
            tables = self._tables_for(first, second)
            adam = kernels[torch.float32].adam
            share_out(
                [partial(adam, table, len(tensors), rate, beta1, beta2, root, eps, self._tau) for table in tables]
            )
            torch._foreach_add_(steps, 1.0)
            flat.renewed()
            if target is not None:
                target.renewed()
            return
        torch._foreach_add_(steps, 1.0)
        options = {"lr": rate, "beta1": beta1, "beta2": beta2, "eps": eps, "weight_decay": 0.0}
        torch._fused_adam_(tensors, flat.grads, first, second, [], steps, **options, amsgrad=False, maximize=False)
        increment_version(tensors)  # torch's function does not
        flat.refresh()
        if target is not None:
            torch._foreach_lerp_(target.tensors, tensors, self._tau)
            target.refresh()

    def _tables_for(self, first: list[Tensor], second: list[Tensor]) -> list[Any]:
        """Return the kernel's tables, which are made again when a tensor or the number of threads is another one."""
        flat, target, shares = self._flat, self._target, crew_size()
        used = [shares, flat.tensors, None if target is None else target.tensors, *first, *second]
        known, tables = self._used
        if len(known) != len(used) or any(one is not other for one, other in zip(known, used, strict=True)):
            tables = _tables(flat, target, first, second, shares)
            self._used = used, tables
        return tables

    def _complete_state(self) -> None:
        """Make the moments contiguous tensors of this optimiser's own, zeros where there are none yet."""
        for parameter in self._flat.originals:
            state = self.state[parameter]
            state.setdefault("step", torch.zeros(()))
            for name in ("exp_avg", "exp_avg_sq"):
                moment = torch.zeros(parameter.shape, dtype=parameter.dtype)
                state[name] = moment.copy_(state[name]) if name in state else moment


def _tables(
    flat: FlatBuffers,
    target: FlatBuffers | None,
    first: list[Tensor],
    second: list[Tensor],
    shares: int,
) -> list[Any]:
    """Return sizes and addresses for one call of the kernel per share of the numbers, see `Parameter` in kernels.c."""
    columns = [flat.tensors, first, second, flat.grads, flat.low if flat.rounds else []]
    columns += [[], []] if target is None else [target.tensors, target.low if target.rounds else []]
    sizes = [tensor.numel() for tensor in flat.tensors]
    tables = []
    for share in range(shares):
        starts = [size * share // shares for size in sizes]
        counts = [size * (share + 1) // shares - start for size, start in zip(sizes, starts, strict=True)]
        addresses = [
            [tensor.data_ptr() + start * tensor.itemsize for tensor, start in zip(column, starts, strict=True)]
            if column
            else [0] * len(sizes)
            for column in columns
        ]
        rows = zip(counts, *addresses, strict=True)
        tables.append((ctypes.c_int64 * (len(sizes) * (1 + len(columns))))(*itertools.chain.from_iterable(rows)))
    return tables
