"""Trained parameters of a loss, and the replacement of those that an optimiser steps."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torch.autograd.graph import increment_version
from torchrl.objectives import LossModule


def trained_parameters(loss_module: LossModule) -> dict[str, list[str]]:
    """Return the names of the trained parameters of the policy (`"actor"`), critics and temperature (`"alpha"`).

    Raises:
        ValueError: If the policy or the critics have no trained parameters.
    """
    groups: dict[str, list[str]] = {"actor": [], "critic": [], "alpha": []}
    for name, parameter in loss_module.named_parameters():
        if parameter.requires_grad:
            kind = "actor" if name.startswith("actor_network_params") else "alpha" if name == "log_alpha" else "critic"
            groups[kind].append(name)
    if not groups["actor"] or not groups["critic"]:
        missing = "critics" if groups["actor"] else "a policy (actor_network_params)"
        raise ValueError(
            f"{type(loss_module).__name__} has no trainable parameters of {missing}: the learner needs both"
        )
    return groups


class Watch:
    """Detector of parameters of a loss or its policy that were replaced, moved in memory or cast to another dtype.

    A parameter gets other memory by `tensor.data = other` or `.to(dtype)`, and its memory moves by `share_memory_()`.
    """

    def __init__(self, loss_module: LossModule) -> None:
        self._loss = loss_module
        self._seen: list[tuple[dict[str, Any], str, Any]] = []
        self._memory: list[tuple[Tensor, Tensor, int]] = []

    def look(self) -> None:
        """Record the present parameters and the modules that contain them."""
        loss: Any = self._loss
        places = [*loss.modules(), *_policy(loss).modules()]
        kept = [module._parameters for module in places] + [params._buffers for params in _sets(loss)]
        self._seen = [(owner, name, value) for owner in (loss._modules, *kept) for name, value in owner.items()]
        tensors = {id(value): value for _, _, value in self._seen if isinstance(value, Tensor)}
        self._memory = [(tensor, tensor.detach(), tensor.data_ptr()) for tensor in tensors.values()]

    def changed(self) -> bool:
        """Return whether anything has changed since the last call of `look`."""
        return any(owner.get(name) is not value for owner, name, value in self._seen) or not all(
            tensor.is_set_to(alias) and tensor.data_ptr() == address for tensor, alias, address in self._memory
        )

    def forget_copies(self) -> None:
        """Drop the detached and batched copies of parameters that TorchRL and tensordict keep."""
        loss: Any = self._loss
        loss._erase_cache()
        for params in _sets(loss):
            _erase_caches(params)


def _sets(loss_module: LossModule) -> list[TensorDictParams]:
    return [child for child in loss_module.children() if isinstance(child, TensorDictParams)]


def _erase_caches(params: Any) -> None:
    params._erase_cache()
    if isinstance(params, TensorDictParams):
        return _erase_caches(params._param_td)
    for value in params.values():
        if isinstance(value, TensorDictBase):
            _erase_caches(value)


def share_actor(loss_module: LossModule) -> None:
    """Give the loss's policy the parameters that the loss trains; in a copied loss the policy has its own."""
    if _apart(loss_module):
        loss: Any = loss_module
        loss.actor_network_params.to_module(loss.actor_network)


def adopt_actor(loss_module: LossModule) -> None:
    """Make the loss train its policy's present parameters, which `load_state_dict(assign=True)` may have replaced."""
    if _apart(loss_module):
        loss: Any = loss_module
        loss.actor_network_params = TensorDict.from_module(loss.actor_network, as_module=True)


def loaded(loss_module: LossModule, _: Any) -> None:
    """Share the actor and raise the parameters' versions after the loss loaded a state, which does neither.

    This hook of a loss uses only its arguments, so that it also works for copies of the loss.
    """
    share_actor(loss_module)
    increment_version([*loss_module.parameters(), *loss_module.buffers()])


def follow(optimizer: torch.optim.Optimizer, params: list[nn.Parameter]) -> None:
    """Replace the parameters of an optimiser with one group, in their order; its state is kept in their dtype."""
    (group,) = optimizer.param_groups
    moment = optimizer.state[params[0]].get("exp_avg") if params[0] in optimizer.state else None
    same = all(new is old for new, old in zip(params, group["params"], strict=True))
    if same and (moment is None or moment.dtype == params[0].dtype):
        return
    saved = optimizer.state_dict()
    group["params"] = params
    optimizer.state.clear()
    optimizer.load_state_dict(saved)


def _apart(loss_module: LossModule) -> bool:
    """Return whether the loss's policy has other parameters than those that the loss trains."""
    loss: Any = loss_module
    own, trained = dict(_policy(loss).named_parameters()), dict(loss.actor_network_params.named_parameters())
    return own.keys() == trained.keys() and any(own[name] is not trained[name] for name in own)


def _policy(loss_module: LossModule) -> nn.Module:
    """Return the policy's module, or an empty one."""
    actor = getattr(loss_module, "actor_network", None)
    return actor if isinstance(actor, nn.Module) else nn.Module()
