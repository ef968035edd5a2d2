"""Gradients of SAC and QR-SAC by `sac.c`, without tensordicts and autograd, each thread on its rows of the batch.

With networks of 3 x 256 units, an update through the loss module spends a third of its time in Python between the
networks' passes, where further threads cannot help. Here each thread makes one call for its rows, from the networks'
inputs to the parameters' gradients.
"""

import ctypes
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule, SACLoss
from torchrl.objectives.value import TD0Estimator

from coachable.distributions.tanh_normal import TanhGaussian
from coachable.fast.crew import crew_size, cut_rows, share_out
from coachable.fast.fused import Plan
from coachable.fast.native import load_sac
from coachable.losses import QRSACLoss
from coachable.networks.actors import GaussianPolicy
from coachable.networks.critics import StyleCritic

_MOST = 8  # layers of a network, or inputs; MOST in sac.c
_I, _F, _P = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Layer(ctypes.Structure):
    _fields_ = (
        *((name, _I) for name in ("inner", "outer", "from_", "to", "width")),
        ("eps", _F),
        *((name, _P) for name in ("weight", "bias", "gamma", "beta", "dweight", "dbias", "dgamma", "dbeta")),
    )


class _Network(ctypes.Structure):
    _fields_ = (
        ("layers", _I),
        ("outputs", _I),
        *((name, _P) for name in ("weight", "bias", "dweight", "dbias")),
        ("layer", _Layer * _MOST),
    )


class _Inputs(ctypes.Structure):
    _fields_ = (("count", _I), ("width", _I * _MOST), ("part", _P * _MOST))


class _Job(ctypes.Structure):
    _fields_ = (
        *((name, _I) for name in ("batch", "axes", "critics", "outputs")),
        *((name, _F) for name in ("alpha", "low", "high", "kappa")),
        *((name, _Inputs) for name in ("policy", "critic", "next_policy", "next_critic")),
        *((name, _P) for name in ("taken", "noise", "next_noise", "reward", "discount")),
        *((name, _P) for name in ("loss", "td_error", "log_prob", "value")),
        *((name, _P) for name in ("actor", "own", "target")),
    )


class Share:
    """Networks for one thread's rows of a batch, as `sac.c` reads them.

    Args:
        actor: Plan of the policy.
        critic: Plan of the critics.
        target: Plan of the target critics.
        gradients: Where the gradients of the policy (`"actor"`) and of the critics (`"critic"`) go, one vector each.
    """

    def __init__(self, actor: Plan, critic: Plan, target: Plan, gradients: dict[str, Tensor]) -> None:
        self.gradients = gradients
        self.function = load_sac(actor.members[0].products[0].dtype)
        self._plans = {"actor": actor, "critic": critic, "target": target}  # addresses do not keep tensors alive
        self.networks = [_networks(plan) for plan in self._plans.values()]

    def mark_written(self, name: str) -> None:
        """Remember that the gradients of a network are set in this update."""
        self._plans[name].written = True


def has_direct_gradients(loss_module: LossModule, *plans: Plan) -> bool:
    """Return whether :class:`DirectGradients` computes a loss, given the plans of its networks."""
    loss: Any = loss_module
    if type(loss) not in (SACLoss, QRSACLoss) or len(loss.actor_network) != 2:
        return False
    module, head = loss.actor_network
    critic, estimator = loss.qvalue_network.module, loss.value_estimator
    quantiles = type(loss) is QRSACLoss
    return (
        all(_readable(plan) for plan in plans)
        and _has_plain_settings(loss)
        and loss._version == 2
        and loss.min_log_alpha is None
        and loss.max_log_alpha is None
        and type(estimator) is TD0Estimator
        and not estimator.average_rewards
        and type(getattr(module, "module", None)) is GaussianPolicy
        and getattr(head, "distribution_class", None) is TanhGaussian
        and not head.distribution_kwargs
        and type(critic) is StyleCritic
        and critic.action_features is None
        and (quantiles or critic.trunk.out_features == 1)
    )


class DirectGradients:
    """Losses of a `SACLoss` or `QRSACLoss` with their gradients.

    The methods draw the same random numbers as the loss and return the same values. The gradients of all threads add up
    in those of `share`.

    Args:
        loss: A loss that :func:`has_direct_gradients`.
        share: Networks whose gradients are used.
        make_share: Makes the networks for one more thread.
    """

    def __init__(self, loss: Any, share: Share, make_share: Callable[[], Share]) -> None:
        self._loss, self._shares, self._make_share = loss, [share], make_share
        self._policy: GaussianPolicy = loss.actor_network[0].module
        self._value: StyleCritic = loss.qvalue_network.module

    def serves(self, batch: TensorDictBase) -> bool:
        """Return whether the batch has no weights of a prioritised buffer and no mask, and the loss plain settings."""
        masks = (batch.get(key, None) for key in self._loss._loss_mask_keys())
        weights = self._loss._maybe_get_priority_weight(batch)
        return _has_plain_settings(self._loss) and weights is None and all(mask is None for mask in masks)

    @torch.no_grad()
    def both(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Set the gradients of policy, critics and temperature, and return the scalar losses, alpha and entropy."""
        found = self._gradients(batch, critic=True, actor=True)
        loss_actor, log_prob = self._actor_loss(found, batch)
        batch.set(self._loss.tensor_keys.priority, found["td_error"].view(batch.batch_size))
        return {
            "loss_actor": loss_actor,
            "loss_qvalue": found["loss"].mean(),
            "loss_alpha": self._alpha_loss(log_prob),
            "alpha": self._loss._alpha,
            "entropy": -log_prob.mean(),
        }

    @torch.no_grad()
    def critic(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critics' loss and `td_error`, after their gradients are set."""
        found = self._gradients(batch, critic=True)
        return found["loss"].mean(), {"td_error": found["td_error"].view(batch.batch_size)}

    @torch.no_grad()
    def actor(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the policy's loss and `log_prob`, after its gradients are set."""
        loss, log_prob = self._actor_loss(self._gradients(batch, actor=True), batch)
        return loss, {"log_prob": log_prob}

    def _actor_loss(self, found: dict[str, Tensor], batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        log_prob = found["log_prob"]
        return (self._loss._alpha * log_prob - found["value"]).mean().to(log_prob), log_prob.view(batch.batch_size)

    def _alpha_loss(self, log_prob: Tensor) -> Tensor:
        with torch.enable_grad():
            loss = self._loss._alpha_loss(log_prob).mean()
        if loss.requires_grad:
            loss.backward()
        return loss.detach()

    def _gradients(self, batch: TensorDictBase, critic: bool = False, actor: bool = False) -> dict[str, Tensor]:
        """Set the gradients of critics, policy or both; return `loss`, `td_error`, `log_prob`, `value`, each `(rows,)`.

        Raises:
            ValueError: If an entry of the batch does not have the width of the networks, which `sac.c` cannot notice.
        """
        loss, count = self._loss, batch.numel()
        policy, own, _ = self._shares[0].networks
        axes = int(policy[0].outputs) // 2
        held: list[Tensor] = []

        def address(tensor: Tensor, name: str, width: int = 1) -> int:
            if tensor.numel() != count * width:
                raise ValueError(f"{name} has the shape {tuple(tensor.shape)}: expected {count} rows of {width}")
            held.append(tensor.float().contiguous())
            return held[-1].data_ptr()

        def inputs(network: GaussianPolicy | StyleCritic, state: TensorDictBase, keys: Sequence[Any]) -> _Inputs:
            tensors, expected = [state.get(keys[0])], policy[0].layer[0].inner
            if network is self._value:
                expected = own[0].layer[0].inner - axes  # the action is its last input
            if network.space is not None:
                tensors.append(network.space.encode(state.get(keys[-1])))
            widths = [tensor.shape[-1] for tensor in tensors]
            if sum(widths) != expected:
                raise ValueError(f"observation and style have {sum(widths)} columns: the network has {expected} inputs")
            addresses = map(address, tensors, ("observation", "style"), widths)
            return _Inputs(len(widths), (_I * _MOST)(*widths), (_P * _MOST)(*addresses))

        found = {name: torch.empty(count) for name in ("loss", "td_error", "log_prob", "value")}
        low, high = self._policy.log_scale_range
        job = _Job(
            *(count, axes, len(own), own[0].outputs, float(loss._alpha), low, high, getattr(loss, "kappa", 0.0)),
            critic=inputs(self._value, batch, loss.qvalue_network.in_keys),
            **{name: address(tensor, name) for name, tensor in found.items()},
        )
        if critic:
            successor, estimator = batch.get("next"), loss.value_estimator
            keys = estimator.tensor_keys
            job.next_policy = inputs(self._policy, successor, loss.actor_network.in_keys)
            job.next_critic = inputs(self._value, successor, loss.qvalue_network.in_keys)
            job.taken = address(batch.get(loss.tensor_keys.action), "action", axes)
            job.reward = address(successor.get(keys.reward), "reward")
            steps = batch.get(keys.steps_to_next_obs, None)
            discount = estimator.gamma if steps is None else estimator.gamma**steps
            job.discount = address(discount * ~successor.get(keys.terminated), "terminated")
            job.next_noise = address(torch.randn(count, axes), "noise", axes)
        if actor:
            job.policy = inputs(self._policy, batch, loss.actor_network.in_keys)
            job.noise = address(torch.randn(count, axes), "noise", axes)
        self._call(job, count, critic, actor)
        return found

    def _call(self, job: _Job, count: int, critic: bool, actor: bool) -> None:
        """Share the rows out among the threads, and add up their gradients."""
        slices = cut_rows(count, crew_size())
        while len(self._shares) < len(slices):
            self._shares.append(self._make_share())
        shares, function, calls = self._shares[: len(slices)], self._shares[0].function, []
        for share, rows in zip(shares, slices, strict=True):
            own = _Job.from_buffer_copy(job)
            own.actor, own.own, own.target = map(ctypes.addressof, share.networks)
            calls.append(partial(function, ctypes.byref(own), rows.start, rows.stop - rows.start, critic, actor))
        share_out(calls)
        first, *others = shares
        for name, wanted in (("actor", actor), ("critic", critic)):
            for other in others if wanted else ():
                first.gradients[name].add_(other.gradients[name])
            if wanted:
                first.mark_written(name)


def _has_plain_settings(loss: Any) -> bool:
    """Return whether the settings of a loss that may change at any time are those of `sac.c`."""
    is_plain = loss.kappa > 0 if type(loss) is QRSACLoss else loss.loss_function == "l2"
    return is_plain and loss.reduction == "mean" and not loss.skip_done_states


def _readable(plan: Plan) -> bool:
    """Return whether `sac.c` can evaluate a plan."""
    own, low = plan.members[0].parameters[0], plan.members[0].products[0]
    return (
        load_sac(low.dtype) is not None
        and len(plan.layers) <= _MOST
        and all(layer.out_features % 2 == 0 for layer in plan.layers)
        and own.dtype == torch.float32
    )


def _networks(plan: Plan) -> Any:
    """Return the members of a plan as an array of networks."""
    networks = (_Network * len(plan.members))()
    for network, member in zip(networks, plan.members, strict=True):
        own, low = ([tensor.data_ptr() for tensor in group] for group in (member.parameters, member.products))
        grads = [tensor.data_ptr() for tensor in member.grads] or [None] * len(own)
        for i, layer in enumerate(plan.layers):
            sizes = layer.in_features, layer.out_features, *layer.skip_columns, layer.eps
            part = slice(4 * i, 4 * i + 4)
            dweight, dbias, dgamma, dbeta = grads[part]
            network.layer[i] = _Layer(*sizes, low[4 * i], *own[part][1:], dweight, dbias, dgamma, dbeta)
        network.layers, network.outputs = len(plan.layers), plan.out_features
        network.weight, network.bias = own[-2:]
        network.dweight, network.dbias = grads[-2:]
    return networks
