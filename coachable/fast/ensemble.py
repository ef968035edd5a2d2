"""Build the plans of residual networks, and evaluate the critics of a loss together, without vmap."""

import copy
from collections.abc import Callable, Mapping
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from coachable.fast.fused import Layer, Member, Plan, residual_network
from coachable.networks.residual import ResidualBlock, ResidualMLP

Triple = tuple[Tensor, Tensor, Tensor | None]
"""Parameter, its rounded copy, and the place of its gradient."""


def residual_networks(module: nn.Module) -> dict[str, ResidualMLP]:
    """Return the residual networks inside `module` by name, if they hold all its parameters and buffers, else `{}`."""
    networks = {name: m for name, m in module.named_modules() if isinstance(m, ResidualMLP)}
    inside = {id(t) for n in networks.values() for t in (*n.parameters(), *n.buffers())}
    everything = {id(t) for t in (*module.parameters(), *module.buffers())}
    return networks if inside == everything else {}


def layers_of(network: ResidualMLP) -> tuple[Layer, ...]:
    """Return the shapes of the layers of a residual network."""
    return tuple(
        Layer(
            in_features=block.linear.in_features,
            out_features=block.linear.out_features,
            side=block.side,
            eps=block.norm.eps,
        )
        for block in network.blocks
        if isinstance(block, ResidualBlock)
    )


def use_plan(network: ResidualMLP, plan: Plan | None) -> None:
    """Evaluate a residual network with `plan` from now on, or layer by layer again (`None`).

    With a plan, gradients go where the plan says and not into the parameters' `.grad`.

    Args:
        network: The network.
        plan: Its plan, or None.
    """
    if plan is None:
        vars(network).pop("forward", None)
    else:
        vars(network)["forward"] = lambda *inputs: residual_network(plan, inputs)


def make_plan(network: ResidualMLP, name: str, tensors: Mapping[str, Triple], members: int, trained: bool) -> Plan:
    """Return the plan of a residual network whose gradients and rounded copies are in flat buffers.

    Args:
        network: The network, for its shapes and the names of its parameters.
        name: Name of the network inside the module, the prefix of its parameters' names.
        tensors: Parameter, rounded copy and gradient by the parameter's full name.
        members: Size K of the ensemble, whose tensors are `(K, ...)`; 0 for one network.
        trained: Whether gradients of the parameters are wanted.
    """
    triples = [tensors[f"{name}.{key}" if name else key] for key, _ in network.named_parameters()]

    def member(k: int | None) -> Member:
        def part(tensor: Tensor | None) -> Tensor:
            assert tensor is not None
            return tensor if k is None else tensor[k]

        return Member(
            [part(own.detach()) for own, _, _ in triples],
            [part(low) for _, low, _ in triples],
            [part(grad) for _, _, grad in triples] if trained else [],
        )

    every = [member(k) for k in range(members)] if members else [member(None)]
    return Plan(layers_of(network), every, stacked=members > 0)


def planned_copy(module: nn.Module, plans: Mapping[str, Plan]) -> nn.Module:
    """Copy the structure of `module`, not its tensors, and evaluate the residual networks of the copy with `plans`.

    Args:
        module: Module that contains residual networks.
        plans: Plan of each residual network, by its name in the module.
    """

    def shell(part: nn.Module) -> nn.Module:
        new = copy.copy(part)
        new._modules = {name: child if child is None else shell(child) for name, child in part._modules.items()}
        return new

    root = shell(module)
    for name, network in residual_networks(root).items():
        use_plan(network, plans[name])
    return root


class CriticEnsemble:
    """Replacement of the vmapped critic of a TorchRL loss, `loss._vmap_qnetworkN0`.

    Called with a tensordict and a stack of parameters, it evaluates the K critics and returns a tensordict
    `[K, *batch]` that holds the critic's output keys.

    Args:
        module: The critic; its networks see `(*batch, d)` and give `(K, *batch, out)`.
        choose: Maps the parameters that the loss passes to the module to evaluate: that of the trained, the frozen or
            the target critics.
        members: Number of critics, K.
    """

    def __init__(self, module: TensorDictModule, choose: Callable[[Any], nn.Module], members: int) -> None:
        self._in_keys, self._out_keys = list(module.in_keys), list(module.out_keys)
        self._choose, self._members = choose, members

    def __call__(self, tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        """Evaluate all critics: `[*batch]` to `[K, *batch]`."""
        values = self._choose(params)(*(tensordict.get(key) for key in self._in_keys))
        values = values if isinstance(values, tuple) else (values,)
        named = dict(zip(self._out_keys, values, strict=True))
        return TensorDict(named, (self._members, *tensordict.batch_size))
