"""Run the residual networks of a loss through their hand-written passes while the learner updates."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule

from coachable.fast.ensemble import CriticEnsemble, Triple, make_plan, planned_copy, residual_networks
from coachable.fast.flat import FlatBuffers
from coachable.fast.fused import Plan


class Acceleration:
    """Hand-written passes for a loss's policy and critics.

    Inside of :meth:`active`, gradients go to the parameters' `.grad`, which are parts of one buffer each for the policy
    and the critics. Outside, the loss is as it was. Call :meth:`bind` if its parameters are others since.

    Args:
        loss_module: A loss for which :meth:`supports` holds.
        dtype: Dtype of the matrix products, `None` for that of the parameters.
    """

    def __init__(self, loss_module: LossModule, dtype: torch.dtype | None) -> None:
        loss: Any = loss_module
        self._loss = loss
        self._actor_names = [name for name, _ in loss.actor_network.named_parameters()]
        self._critic_names = [name for name, _ in loss.qvalue_network.named_parameters()]
        actor, critic, target = self._leaves()
        self.actor = FlatBuffers(actor, dtype, trained=True)
        self.critic = FlatBuffers(critic, dtype, trained=True)
        self.target = FlatBuffers(target, dtype, trained=False)
        self._buffers = (self.actor, self.critic, self.target)
        self._prepare()

    def _leaves(self) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Parameters of policy, critics and target critics that the loss has now."""
        loss = self._loss
        return (
            _leaves(loss.actor_network_params, self._actor_names),
            _leaves(loss.qvalue_network_params, self._critic_names),
            _leaves(loss.target_qvalue_network_params, self._critic_names),
        )

    def _prepare(self) -> None:
        """Make what works on the tensors in the buffers."""
        critic = self._loss.qvalue_network
        members = self.critic.tensors[0].shape[0]
        self._trained = [*zip(self.actor.originals, self.actor.grads, strict=True)]
        self._trained += zip(self.critic.originals, self.critic.grads, strict=True)
        self._policies = residual_networks(self._loss.actor_network)
        self._actor_plans = {
            name: make_plan(network, name, _triples(self.actor, self._actor_names), 0, trained=True)
            for name, network in self._policies.items()
        }

        def plans(flat: FlatBuffers, trained: bool) -> dict[str, Plan]:
            tensors = _triples(flat, self._critic_names)
            networks = residual_networks(critic).items()
            return {name: make_plan(net, name, tensors, members, trained=trained) for name, net in networks}

        self._critic_plans = plans(self.critic, True)
        self.trained_critics = _critics(critic, self._critic_plans)
        self.frozen_critics = _critics(critic, plans(self.critic, False))
        self.target_critics = _critics(critic, plans(self.target, False))
        self._ensemble = CriticEnsemble(critic, self._choose, members)

    def bind(self) -> None:
        """Go on with the loss's parameters as they are now, after they were replaced, cast or given other memory.

        Raises:
            RuntimeError: If :meth:`supports` does not hold any more.
        """
        if not self.supports(self._loss):
            raise RuntimeError(
                f"{type(self._loss).__name__} changed since its learner was made (another device, frozen parameters or "
                "other networks): make a new learner for it"
            )
        for flat, tensors in zip(self._buffers, self._leaves(), strict=True):
            flat.bind(tensors)
        self._prepare()

    @staticmethod
    def supports(loss_module: LossModule) -> bool:
        """Whether all networks are residual ones, on a CPU, and the critics are evaluated in SACLoss's way."""
        loss: Any = loss_module
        critic = getattr(loss, "qvalue_network", None)
        networks = {"actor_network_params", "qvalue_network_params"}
        parts = {(name.split(".")[0], p.requires_grad) for name, p in loss_module.named_parameters()}
        return (
            hasattr(loss, "_vmap_qnetworkN0")
            and {part for part, trained in parts if trained} <= networks | {"log_alpha"}
            and not any(part in networks for part, trained in parts if not trained)
            and all(p.device.type == "cpu" for p in loss_module.parameters())
            and isinstance(critic, TensorDictModule)
            and isinstance(critic.module, nn.Module)
            and bool(residual_networks(critic))
            and bool(residual_networks(loss.actor_network))
            and any(name.startswith("target_qvalue_network_params") for name, _ in loss_module.named_buffers())
        )

    def _choose(self, params: TensorDictBase) -> nn.Module:
        loss = self._loss
        if params is loss.qvalue_network_params:
            return self.trained_critics
        if params is loss.target_qvalue_network_params:
            return self.target_critics
        first: Tensor = next(iter(params.values(True, True)))  # pyright: ignore[reportAssignmentType]
        own: Tensor = next(iter(loss.qvalue_network_params.values(True, True)))
        if first.data_ptr() == own.data_ptr() and not first.requires_grad:
            return self.frozen_critics
        raise RuntimeError(
            f"{type(loss).__name__} evaluates its critics with parameters that are neither its own nor its targets': "
            "pass fused=False to the learner"
        )

    @contextmanager
    def active(self) -> Iterator[None]:
        """Evaluate policy and critics with the hand-written passes inside the block."""
        loss = self._loss
        ordinary = loss._vmap_qnetworkN0
        for flat in self._buffers:
            flat.refresh()
        for plan in (*self._actor_plans.values(), *self._critic_plans.values()):
            plan.begin()
        for parameter, grad in self._trained:
            parameter.grad = grad
        loss._vmap_qnetworkN0 = self._ensemble
        for name, network in self._policies.items():
            network.use_plan(self._actor_plans[name])
        try:
            yield
        finally:
            loss._vmap_qnetworkN0 = ordinary
            for network in self._policies.values():
                network.use_plan(None)
            for parameter, _ in self._trained:
                parameter.grad = None

    def buffers(self, name: str) -> tuple[FlatBuffers, FlatBuffers | None]:
        """Buffers of the `"actor"` or the `"critic"`, and those of its target network."""
        return (self.actor, None) if name == "actor" else (self.critic, self.target)

    def gradient(self, name: str) -> Tensor:
        """Gradient of the `"actor"` or the `"critic"` as one vector, after the backward pass."""
        for plan in (self._actor_plans if name == "actor" else self._critic_plans).values():
            plan.finish()
        return (self.actor if name == "actor" else self.critic).grad


def _critics(critic: TensorDictModule, plans: dict[str, Plan]) -> nn.Module:
    module: Any = planned_copy(critic, plans)
    return module.module


def _leaves(params: Any, names: list[str]) -> list[Tensor]:
    tensors = dict(params.named_parameters()) or dict(params.named_buffers())
    return [tensors[name] for name in names]


def _triples(flat: FlatBuffers, names: list[str]) -> dict[str, Triple]:
    grads = flat.grads or [None] * len(names)
    return dict(zip(names, zip(flat.tensors, flat.low, grads, strict=True), strict=True))
