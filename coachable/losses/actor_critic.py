"""Base class of QR-SAC, RAC, Cat-RAC and categorical SAC."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.objectives import SACLoss, ValueEstimators

from coachable.distributions.mixed_action import MixedAction
from coachable.distributions.tanh_gaussian import at_least_float32
from coachable.losses.functional import bootstrap_target
from coachable.losses.policy import PolicyReader
from coachable.ranges import POSITIVE, SHARE


class ActorCriticLoss(SACLoss):
    """Soft actor-critic loss with a fixed entropy weight, whose policy sample and critic a subclass defines.

    `actor_loss(td)` and `qvalue_loss(td)` return `(loss, metadata)`. If you step them one after the other, the target
    uses the updated policy. `forward` computes both from the same parameters. All three accept any batch shape, such as
    `[B]` or `[B, n + 1]`, and average over it, weighted by `priority_weight` if the batch has it. Rewards with
    `steps_to_next_obs` are n-step returns and are discounted accordingly. Everything after the networks is computed in
    float32 or wider, also under autocast.

    Subclasses define `_sample` (action and negative entropy), `_values` (critic output to scalars), `_next_value`
    (target critics' output to the successor's value) and `_errors` (regression of the critics on the target).
    Their names must not contain `loss`, because TorchRL wraps such methods.

    Args:
        actor_network: Policy, from `make_gaussian_actor` or `make_mixed_actor`.
        qvalue_network: List of critics, each built by its own call of a critic factory.
        num_qvalue_nets: Number of critics, checked against the list.
        alpha: Weight of the entropy, fixed.
        action_spec: The environment's action spec, which is checked against the actor; None for no check.

    Raises:
        ValueError: If a number is out of range, or the loss does not support the actions.
    """

    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0,)
    _continuous_only = False
    _policy: PolicyReader

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_qvalue_nets: int = 2,
        alpha: float = 0.01,
        action_spec: TensorSpec | None = None,
    ) -> None:
        name = type(self).__name__
        critics = [qvalue_network] if isinstance(qvalue_network, nn.Module) else list(qvalue_network)
        if num_qvalue_nets < 1 or len(critics) != num_qvalue_nets:
            raise ValueError(
                f"{name} got {len(critics)} critic(s) for num_qvalue_nets={num_qvalue_nets}: pass a list of that many, "
                "each built separately"
            )
        if len(set(map(id, critics))) < len(critics):
            raise ValueError(f"{name} got the same critic more than once: expected critics built separately")
        POSITIVE.check("alpha", alpha)
        policy = PolicyReader(actor_network, name, continuous_only=self._continuous_only, action_spec=action_spec)
        # TorchRL makes buffers of a list of one, and draws new weights for a single critic, so they are restored below.
        single = cast(TensorDict, TensorDict.from_module(critics[0])).data.clone() if len(critics) == 1 else None
        super().__init__(
            actor_network,
            critics if single is None else critics[0],  # pyright: ignore[reportArgumentType]  # documented as a list too
            num_qvalue_nets=num_qvalue_nets,
            loss_function="l2",
            alpha_init=alpha,
            fixed_alpha=True,
            target_entropy=0.0,  # not used; "auto" would need an action spec
        )
        if single is not None:
            for params in (self.qvalue_network_params, self.target_qvalue_network_params):
                cast(TensorDictBase, params).data.copy_(single.unsqueeze(0))
        # In float64, like gamma, for the precision of float64 losses; it does not widen float32 tensors.
        self.log_alpha = torch.tensor(math.log(alpha), dtype=torch.float64, device=cast(Tensor, self.log_alpha).device)
        self._policy = policy  # not a submodule, because its parameters are those of actor_network_params
        self.make_value_estimator()

    # Methods that a subclass defines.

    def _sample(self, policy: MixedAction, *, relaxed: bool) -> tuple[Tensor, Tensor]:
        """Return an action (..., A) and its negative entropy (...,), here its log-density as in SAC."""
        return policy.relaxed_sample() if relaxed else policy.hard_sample()

    def _values(self, output: Tensor) -> Tensor:
        """Return values (K, ...) from critic output (K, ..., out)."""
        raise NotImplementedError

    def _next_value(self, output: Tensor) -> Tensor:
        """Return the successor's value (...,) or quantiles (..., M) from the target critics' output (K, ..., out)."""
        return self._values(output).min(0).values

    def _errors(self, output: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return the losses (K, ...) of the critics against the target, and their absolute TD errors (K, ...)."""
        raise NotImplementedError

    # Methods that TorchRL calls.

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the policy loss `mean(alpha log pi - min_k Q_k)` of relaxed actions, without critic gradient.

        Returns:
            The loss, and `log_prob`, the negative entropy (...,) of each state.
        """
        policy = self._policy_at(tensordict)
        with self._full_precision():
            action, log_prob = self._sample(policy, relaxed=True)
            self._checked("_sample", log_prob, tensordict.batch_size)
        output = self._critics_at(tensordict, action, self._cached_detached_qvalue_params)
        with self._full_precision():
            value = self._checked("_values", self._values(output), output.shape[:-1]).min(0).values
            loss = self._alpha * log_prob - value
            return self._reduced(loss, tensordict), {"log_prob": log_prob.detach()}

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critic loss, summed over the critics; the target uses the present policy.

        Returns:
            The loss, and `td_error` (...,), the largest one of the critics.
        """
        target = self.compute_target(tensordict)
        output = self._critics_at(tensordict, None, self.qvalue_network_params)
        with self._full_precision():
            losses, errors = self._errors(at_least_float32(output), target)
            losses, errors = (self._checked("_errors", value, output.shape[:-1]) for value in (losses, errors))
            loss = self._reduced(losses.sum(0), tensordict)
            return loss, {"td_error": errors.detach().amax(0), **self._extra_metrics(target)}

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return `qvalue_loss`; TorchRL calls it by this name."""
        return self.qvalue_loss(tensordict)

    @torch.no_grad()
    def compute_target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the target (...,) or (..., M), from hard actions of the present policy and the target critics.

        The discount includes the successor's entropy, so that a terminal step has none.
        """
        successor = tensordict.get("next")
        policy = self._policy_at(successor)
        with self._full_precision():
            action, log_prob = self._sample(policy, relaxed=False)
            self._checked("_sample", log_prob, successor.batch_size)
        output = self._critics_at(successor, action, self.target_qvalue_network_params)
        with self._full_precision():
            next_value = self._next_value(at_least_float32(output))
            quantiles = next_value.shape[-1:] if next_value.ndim > log_prob.ndim else ()
            self._checked("_next_value", next_value, (*successor.batch_size, *quantiles))
            if next_value.ndim > log_prob.ndim:
                log_prob = log_prob.unsqueeze(-1)
            return bootstrap_target(
                self._scalar(successor, self.tensor_keys.reward).to(next_value.dtype),
                next_value - self._alpha * log_prob,
                self._scalar(successor, self.tensor_keys.terminated),
                self._gamma,
                self._scalar(tensordict, self.value_estimator.tensor_keys.steps_to_next_obs, required=False),
            )

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return both losses, computed from the same parameters.

        Args:
            tensordict: Batch, into which only the priority (`td_error`) is written.

        Returns:
            `loss_actor`, `loss_qvalue`, `alpha`, `entropy`, and the loss's own metrics.
        """
        loss_qvalue, critic = self.qvalue_loss(tensordict)
        loss_actor, actor = self.actor_loss(tensordict)
        tensordict.set(self.tensor_keys.priority, critic.pop("td_error"))
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, "alpha": self._alpha}
        return TensorDict({**losses, "entropy": -actor["log_prob"].mean(), **critic})

    @property
    def out_keys(self) -> list[str]:
        """Keys of the result of `forward`."""
        return list(self._out_keys or ["loss_actor", "loss_qvalue", "alpha", "entropy"])

    @out_keys.setter
    def out_keys(self, values: list[str]) -> None:
        self._out_keys = values

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> ActorCriticLoss:
        """Set `gamma`. Only TD(0) is supported; pass n-step returns as rewards with `steps_to_next_obs`.

        Args:
            value_type: None or `ValueEstimators.TD0`.
            **hyperparams: `gamma`, the discount in [0, 1], and `device`.

        Returns:
            This loss.

        Raises:
            ValueError: If another estimator or another hyper-parameter is asked for, or gamma is out of range.
        """
        if value_type not in (None, ValueEstimators.TD0) or set(hyperparams) - {"gamma", "device"}:
            raise ValueError(
                f"{type(self).__name__} computes its own TD(0) target and takes gamma alone, got value_type="
                f"{value_type}, {sorted(hyperparams)}; for n-step targets store n-step rewards with steps_to_next_obs"
            )
        if "gamma" in hyperparams:
            SHARE.check("gamma", float(hyperparams["gamma"]))
        super().make_value_estimator(ValueEstimators.TD0, **hyperparams)
        if "gamma" in hyperparams:
            exact = torch.as_tensor(hyperparams["gamma"], dtype=torch.float64)
            self.value_estimator.gamma = exact.to(self._gamma.device)
        return self

    def _extra_metrics(self, target: Tensor) -> dict[str, Tensor]:
        """Return further scalars of the critic update, for logging."""
        return {}

    def _checked(self, method: str, value: Tensor, expected: Sequence[int]) -> Tensor:
        """Return a result of a subclass's method; another shape would broadcast to values of other states."""
        if value.shape != torch.Size(expected):
            raise RuntimeError(
                f"{type(self).__name__}.{method} returned the shape {tuple(value.shape)}: expected {tuple(expected)}"
            )
        return value

    def _policy_at(self, tensordict: TensorDictBase) -> MixedAction:
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            return self._policy.read(tensordict)

    def _critics_at(self, tensordict: TensorDictBase, action: Tensor | None, params: TensorDictBase) -> Tensor:
        """Return the output (K, ..., out) of all critics at `action`, or at the stored one if it is None."""
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        if action is not None:
            inputs.set(self.tensor_keys.action, action)
        critics = cast(Callable[..., TensorDictBase], self._vmap_qnetworkN0)
        output = critics(inputs, params).get(self.tensor_keys.state_action_value)
        expected = self.critic_outputs()
        if output.shape[1:-1] != tensordict.batch_size or output.shape[-1] != expected:
            raise RuntimeError(
                f"{type(self).__name__} expects critics with {expected} output(s) per sample, "
                f"({self.num_qvalue_nets}, *{tuple(tensordict.batch_size)}, {expected}), got {tuple(output.shape)}: "
                "set num_outputs of the critic"
            )
        return output

    @property
    def _gamma(self) -> Tensor:
        return cast(Tensor, self.value_estimator.gamma)

    def critic_outputs(self) -> int:
        """Return the number of outputs of one critic."""
        return 1

    def _scalar(self, tensordict: TensorDictBase, key: Any, required: bool = True) -> Any:
        """Return an entry (..., 1) or (...,) as (...,); None if it is missing and not required."""
        value = tensordict[key] if required else tensordict.get(key, None)
        if value is None or value.ndim == tensordict.ndim:
            return value
        return value.squeeze(-1)

    def _reduced(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = self._maybe_get_priority_weight(tensordict)
        if weights is not None and weights.shape != loss.shape:
            # One weight per record, also if the batch is [B, n + 1].
            if weights.ndim != loss.ndim:
                weights = weights.squeeze(-1) if weights.ndim > loss.ndim else weights.unsqueeze(-1)
            weights = weights.expand_as(loss)
        return cast(Tensor, self._reduce_loss(loss, tensordict=tensordict, weights=weights))

    def _full_precision(self) -> torch.autocast:
        return torch.autocast(cast(Tensor, self.log_alpha).device.type, enabled=False)
