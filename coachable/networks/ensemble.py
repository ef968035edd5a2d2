"""Evaluate the critics of a loss together, without vmap."""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from coachable.networks.fused import Plan
from coachable.networks.residual import ResidualMLP


class Shadow:
    """Low-precision copies of the weights and biases of residual networks, refreshed from the float32 masters.

    Args:
        networks: The networks, whose parameters may be stacked `(K, ...)`.
        dtype: Dtype of the copies; `None` to compute with the parameters themselves.
    """

    def __init__(self, networks: list[ResidualMLP], dtype: torch.dtype | None) -> None:
        self.plans: list[Plan] = []
        self._masters: list[Tensor] = []
        self._copies: list[Tensor] = []
        for network in networks:
            plan = network.plan()
            if dtype is not None:
                masters = [p.detach() for block in network.blocks for p in (block.linear.weight, block.linear.bias)]  # pyright: ignore
                plan.low = [torch.empty_like(m, dtype=dtype) for m in masters]
                self._masters += masters
                self._copies += plan.low
            self.plans.append(plan)

    def refresh(self) -> None:
        """Copy the masters."""
        if self._copies:
            torch._foreach_copy_(self._copies, self._masters)


def residual_networks(module: nn.Module) -> list[ResidualMLP] | None:
    """Return the residual networks inside `module` if they hold all of its parameters and buffers, else `None`."""
    networks = [m for m in module.modules() if isinstance(m, ResidualMLP)]
    inside = {id(t) for n in networks for t in (*n.parameters(), *n.buffers())}
    everything = {id(t) for t in (*module.parameters(), *module.buffers())}
    return networks if networks and inside == everything else None


class CriticEnsemble:
    """Stands in for the vmapped critic of a TorchRL loss (`loss._vmap_qnetworkN0`).

    Called with a tensordict and a stack of parameters, it evaluates the K critics with the hand-written passes of
    :mod:`coachable.networks.fused` and returns a tensordict `[K, *batch]` that holds the critic's output keys. The
    parameters must be the loss's own: trained, detached, or target.

    Args:
        module: The critic of the loss (any of its copies); its parameters must all lie in residual networks.
        params: The trained parameters, `[K]`.
        target_params: The target networks' parameters, `[K]`.
        dtype: Dtype of the products, `None` for that of the parameters.
    """

    def __init__(
        self,
        module: TensorDictModule,
        params: TensorDictBase,
        target_params: TensorDictBase,
        dtype: torch.dtype | None,
    ) -> None:
        self._dtype = dtype
        self._in_keys, self._out_keys = list(module.in_keys), list(module.out_keys)
        self._params, self._target_params = params, target_params
        self._template = module.module
        self.bind()

    @staticmethod
    def supports(module: Any) -> bool:
        """Whether the critic is one module whose parameters all lie in residual networks."""
        single = isinstance(module, TensorDictModule) and isinstance(module.module, nn.Module)
        return single and residual_networks(module) is not None

    def bind(self) -> None:
        """Take hold of the loss's tensors (again, after they were replaced rather than overwritten)."""
        trained = _with_parameters(self._template, self._params, detach=False)
        frozen = _with_parameters(self._template, self._params, detach=True)
        target = _with_parameters(self._template, self._target_params, detach=True)
        self._live = Shadow(_networks(frozen), self._dtype)
        self._target = Shadow(_networks(target), self._dtype)
        for shadow, module in ((self._live, trained), (self._live, frozen), (self._target, target)):
            for network, plan in zip(_networks(module), shadow.plans, strict=True):
                network.use_plan(plan)
        self._trained, self._frozen, self._targets = trained, frozen, target
        first = next(iter(self._params.values(True, True)))
        self._size, self._address = first.shape[0], first.data_ptr()
        self.refresh()

    def refresh(self, target: bool = True) -> None:
        """Renew the low-precision weights after the parameters changed; `target=False` skips the target networks."""
        self._live.refresh()
        if target:
            self._target.refresh()

    def __call__(self, tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        """Evaluate all critics: `[*batch]` to `[K, *batch]`."""
        module = self._module(params)
        shape = (self._size, *tensordict.batch_size)
        inputs = []
        for key in self._in_keys:
            value = tensordict.get(key)
            inputs.append(value.expand(self._size, *value.shape))
        values = module(*inputs)
        values = values if isinstance(values, tuple) else (values,)
        return TensorDict(dict(zip(self._out_keys, values, strict=True)), shape)

    def _module(self, params: TensorDictBase) -> nn.Module:
        if params is self._params:
            return self._trained
        if params is self._target_params:
            return self._targets
        first = next(iter(params.values(True, True)))
        if first.data_ptr() != self._address or first.requires_grad:
            raise RuntimeError("the critics of this loss can only be evaluated with its own parameters or targets")
        return self._frozen


def _networks(module: nn.Module) -> list[ResidualMLP]:
    return [m for m in module.modules() if isinstance(m, ResidualMLP)]


def _with_parameters(module: nn.Module, params: TensorDictBase, *, detach: bool) -> nn.Module:
    """A copy of `module`'s structure that holds the tensors of `params` (found under the key `module`)."""

    def shell(part: nn.Module) -> nn.Module:
        new = copy.copy(part)
        new._modules = {name: child if child is None else shell(child) for name, child in part._modules.items()}
        new._parameters = dict(part._parameters)
        return new

    root = shell(module)
    for path in [tuple(name.split(".")) for name, _ in module.named_parameters()]:
        owner = root.get_submodule(".".join(path[:-1]))
        tensor = params.get(("module", *path))
        owner._parameters[path[-1]] = tensor.detach() if detach else tensor  # pyright: ignore
    return root
