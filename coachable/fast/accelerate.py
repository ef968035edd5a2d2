"""Run the residual networks of a loss through their hand-written passes while the learner updates."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule, SoftUpdate

from coachable.fast.crew import crew
from coachable.fast.direct import DirectGradients, Share, has_direct_gradients
from coachable.fast.ensemble import CriticEnsemble, make_plan, planned_copy, residual_networks, use_plan
from coachable.fast.flat import FlatBuffers
from coachable.fast.flat_adam import FlatAdam
from coachable.fast.fused import Plan
from coachable.fast.native import KERNEL_THREADS, load_kernels
from coachable.networks.residual import ResidualMLP
from coachable.training.backend import Backend
from coachable.training.learner import Learner
from coachable.training.loss_functions import LossFunctions

_LOG = logging.getLogger(__name__)

When = Literal["auto", "on", "off"]


def accelerate(learner: Learner, when: When | bool = "auto") -> bool:
    """Switch a learner to hand-written passes, a flat optimiser and, with a C compiler, the kernels of `kernels.c`.

    The results are the same up to rounding, and so is the format of `learner.state_dict()`. With `precision="bf16"`,
    changes of parameters through `.data` are not noticed before the next update; other changes in place are.

    Args:
        learner: The learner. Its optimisers keep their state.
        when: `"auto"` switches where that is possible and logs why where it is not, `"on"` raises there, and `"off"`
            does nothing. `True` and `False` stand for `"on"` and `"off"`, because YAML reads these words so.

    Returns:
        Whether the learner is switched.

    Raises:
        ValueError: If `when` is unknown, or `"on"` is impossible.
    """
    if not isinstance(when, bool) and when not in get_args(When):
        raise ValueError(f"fast={when}: expected one of {', '.join(get_args(When))}")
    if when in ("off", False):
        return False
    if reason := obstacle(learner.loss_module):
        if when in ("on", True):
            raise ValueError(f"fast=on is impossible: {reason}. Expected fast=auto or fast=off")
        _LOG.info("fast=auto leaves the learner in plain torch: %s", reason)
        return False
    learner.use_backend(Acceleration)
    return True


def obstacle(loss_module: LossModule) -> str | None:
    """Return why a loss cannot be accelerated, or `None` if it can.

    It can if all networks are residual ones without dropout on a CPU, are trained entirely, and evaluate their critics
    as TorchRL's `SACLoss` does.
    """
    loss: Any = loss_module
    if device := {p.device.type for p in loss_module.parameters()} - {"cpu"}:
        return f"the networks are on the device {device.pop()}, not on a CPU"
    if not hasattr(loss, "_vmap_qnetworkN0"):
        return f"{type(loss).__name__} does not evaluate its critics as SACLoss does"
    networks = {"actor_network_params", "qvalue_network_params"}
    parts = {(name.split(".")[0], p.requires_grad) for name, p in loss_module.named_parameters()}
    if others := {part for part, trained in parts if trained} - networks - {"log_alpha"}:
        return f"the loss trains {', '.join(sorted(others))} besides its policy and critics"
    if frozen := {part for part, trained in parts if not trained} & networks:
        return f"some parameters of {', '.join(sorted(frozen))} are frozen"
    critic = loss.qvalue_network
    if not isinstance(critic, TensorDictModule) or not isinstance(critic.module, nn.Module):
        return "the critic is not a module inside a TensorDictModule"
    for name, network in (("policy", loss.actor_network), ("critic", critic)):
        if any(isinstance(module, nn.Dropout) for module in network.modules()):
            return f"the {name} has dropout"
        if not residual_networks(network):
            return f"the {name} has parameters outside of residual networks"
    targets = {
        name.split(".")[0] for name, _ in loss_module.named_buffers() if name.startswith("target_") and "." in name
    }
    if "target_qvalue_network_params" not in targets:
        return "the critics have no target network"
    if others := targets - {"target_qvalue_network_params"}:
        return f"the loss has {', '.join(sorted(others))} besides the critics' target network"
    return None


class Acceleration(Backend):
    """Hand-written passes for a loss's policy and critics, and `FlatAdam` for both.

    During an update, gradients go to the parameters' `.grad`, which are parts of one buffer each for the policy and the
    critics. Between updates, the loss is as it was.

    Args:
        loss_module: A loss without an :func:`obstacle`.
        precision: Precision of the matrix products.
        target_updater: Its rate is that of the target networks, which the optimiser of the critics moves.
    """

    compiles = False

    def __init__(self, loss_module: LossModule, precision: Literal["fp32", "bf16"], target_updater: SoftUpdate) -> None:
        super().__init__(loss_module, precision, target_updater)
        loss: Any = loss_module
        dtype = torch.bfloat16 if precision == "bf16" else None
        self._loss = loss
        self._actor_names = [name for name, _ in loss.actor_network.named_parameters()]
        self._critic_names = [name for name, _ in loss.qvalue_network.named_parameters()]
        actor, critic, target = self._leaves()
        self._actor = FlatBuffers(actor, dtype, trained=True)
        self._critic = FlatBuffers(critic, dtype, trained=True)
        self._target = FlatBuffers(target, dtype, trained=False)
        self._buffers = (self._actor, self._critic, self._target)
        self._prepare()

    def working(self) -> AbstractContextManager[Any]:
        """Keep torch at one thread, because its own wait for work in a loop that takes a core from the crew.

        With many threads, torch's own operations are used, but not for losses whose gradients `sac.c` computes.
        """
        few = self._direct is not None or torch.get_num_threads() <= KERNEL_THREADS
        return crew(KERNEL_THREADS if load_kernels() and few else 1)

    @contextmanager
    def updating(self) -> Iterator[None]:
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
        # The plans hold the policy's parameters, so that swapping them into its modules would change nothing.
        vars(loss.actor_network_params)["to_module"] = lambda *_, **__: nullcontext()
        for name, network in self._policies.items():
            use_plan(network, self._actor_plans[name])
        try:
            with self.working():
                yield
        finally:
            loss._vmap_qnetworkN0 = ordinary
            del vars(loss.actor_network_params)["to_module"]
            for network in self._policies.values():
                use_plan(network, None)
            for parameter, _ in self._trained:
                parameter.grad = None

    def evaluating(self) -> AbstractContextManager[Any]:
        """Return a context without effect, because the passes choose their precision themselves."""
        return nullcontext()

    def both(self, losses: LossFunctions, batch: TensorDictBase, trained: Sequence[str]) -> Any:
        """Evaluate all losses and set their gradients, see :meth:`Backend.both`."""
        direct = self._direct_for(batch)
        return direct.both(batch) if direct else super().both(losses, batch, trained)

    def actor(self, losses: LossFunctions, batch: TensorDictBase) -> tuple[Tensor, Any]:
        """Evaluate the policy's loss and set its gradients, see :meth:`Backend.actor`."""
        direct = self._direct_for(batch)
        return direct.actor(batch) if direct else super().actor(losses, batch)

    def critic(self, losses: LossFunctions, batch: TensorDictBase) -> tuple[Tensor, Any]:
        """Evaluate the critics' loss and set its gradients, see :meth:`Backend.critic`."""
        direct = self._direct_for(batch)
        return direct.critic(batch) if direct else super().critic(losses, batch)

    def make_optimizer(self, name: str, params: list[nn.Parameter], lr: float, eps: float) -> torch.optim.Adam:
        """Return `FlatAdam` for the policy and the critics, `torch.optim.Adam` for the temperature."""
        if name == "alpha":
            return super().make_optimizer(name, params, lr, eps)
        flat, target = (self._actor, None) if name == "actor" else (self._critic, self._target)
        return FlatAdam(params, flat, target, 1.0 - self.target_updater.eps, lr=lr, eps=eps)

    def gradient_norm(self, name: str, params: list[nn.Parameter]) -> Tensor:
        """Return the 2-norm of the gradient, see :meth:`Backend.gradient_norm`; it is zero without a backward pass."""
        if name == "alpha":
            return super().gradient_norm(name, params)
        plans, flat = (self._actor_plans, self._actor) if name == "actor" else (self._critic_plans, self._critic)
        for plan in plans.values():
            plan.finish()
        return torch.linalg.vector_norm(flat.grad)

    def move_targets(self) -> None:
        """Do nothing, because the optimiser of the critics has moved the targets."""

    def follow(self) -> None:
        """Continue with the parameters that the loss has now.

        Raises:
            RuntimeError: If the loss has an :func:`obstacle` now.
        """
        if reason := obstacle(self._loss):
            raise RuntimeError(
                f"{type(self._loss).__name__} changed since its learner was accelerated: {reason}. Make a new learner "
                "for it"
            )
        for flat, tensors in zip(self._buffers, self._leaves(), strict=True):
            flat.bind(tensors)
        self._prepare()

    def _direct_for(self, batch: TensorDictBase) -> DirectGradients | None:
        return self._direct if self._direct is not None and self._direct.serves(batch) else None

    def _leaves(self) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Return the parameters of policy, critics and target critics that the loss has now."""
        loss = self._loss
        return (
            _leaves(loss.actor_network_params, self._actor_names),
            _leaves(loss.qvalue_network_params, self._critic_names),
            _leaves(loss.target_qvalue_network_params, self._critic_names),
        )

    def _prepare(self) -> None:
        """Make the plans and modules that work on the tensors in the buffers."""
        critic = self._loss.qvalue_network
        members = self._critic.tensors[0].shape[0]
        self._trained = [*zip(self._actor.originals, self._actor.grads, strict=True)]
        self._trained += zip(self._critic.originals, self._critic.grads, strict=True)
        self._policies = residual_networks(self._loss.actor_network)
        self._actor_plans = self._plans(self._policies, self._actor, self._actor_names, 0)
        networks = residual_networks(critic)
        names = self._critic_names
        self._critic_plans = self._plans(networks, self._critic, names, members)
        target_plans = self._plans(networks, self._target, names, members)
        self._trained_critics = _critics(critic, self._critic_plans)
        self._frozen_critics = _critics(critic, self._plans(networks, self._critic, names, members, []))
        self._target_critics = _critics(critic, target_plans)
        self._ensemble = CriticEnsemble(critic, self._choose, members)
        self._direct = None
        every = (self._actor_plans, self._critic_plans, target_plans)
        if all(len(plans) == 1 for plans in every):
            (policy,), (own,), (target,) = (plans.values() for plans in every)
            if has_direct_gradients(self._loss, policy, own, target):
                share = Share(policy, own, target, {"actor": self._actor.grad, "critic": self._critic.grad})
                self._direct = DirectGradients(self._loss, share, self._another_share)

    def _another_share(self) -> Share:
        """Return plans of the same parameters, with gradients of their own."""
        networks, members = residual_networks(self._loss.qvalue_network), self._critic.tensors[0].shape[0]
        names = self._critic_names
        gradients = {"actor": self._actor.another_gradient(), "critic": self._critic.another_gradient()}
        (actor,) = self._plans(self._policies, self._actor, self._actor_names, 0, gradients["actor"][1]).values()
        (critic,) = self._plans(networks, self._critic, names, members, gradients["critic"][1]).values()
        (target,) = self._plans(networks, self._target, names, members).values()
        return Share(actor, critic, target, {name: vector for name, (vector, _) in gradients.items()})

    @staticmethod
    def _plans(
        networks: dict[str, ResidualMLP],
        flat: FlatBuffers,
        names: list[str],
        members: int,
        gradients: list[Tensor] | None = None,
    ) -> dict[str, Plan]:
        """Return the plans of residual networks by name.

        Args:
            networks: The networks by name.
            flat: Their buffers.
            names: Names of the tensors in the buffers.
            members: Size of the ensemble; 0 for one network.
            gradients: Where the gradients go; the buffers' own by default, none if it is empty.
        """
        places = flat.grads if gradients is None else gradients
        triples = zip(flat.tensors, flat.low, places or [None] * len(names), strict=True)
        tensors = dict(zip(names, triples, strict=True))
        return {name: make_plan(net, name, tensors, members, trained=bool(places)) for name, net in networks.items()}

    def _choose(self, params: TensorDictBase) -> nn.Module:
        loss = self._loss
        if params is loss.qvalue_network_params:
            return self._trained_critics
        if params is loss.target_qvalue_network_params:
            return self._target_critics
        first: Tensor = next(iter(params.values(True, True)))  # pyright: ignore[reportAssignmentType]
        own: Tensor = next(iter(loss.qvalue_network_params.values(True, True)))
        if first.data_ptr() == own.data_ptr() and not first.requires_grad:
            return self._frozen_critics
        raise RuntimeError(
            f"{type(loss).__name__} evaluates its critics with parameters that are neither its own nor its targets': "
            "do not accelerate its learner (fast=off)"
        )


def _critics(critic: TensorDictModule, plans: dict[str, Plan]) -> nn.Module:
    module: Any = planned_copy(critic, plans)
    return module.module


def _leaves(params: Any, names: list[str]) -> list[Tensor]:
    tensors = dict(params.named_parameters()) or dict(params.named_buffers())
    return [tensors[name] for name in names]
