"""TorchRL's `SACLoss` without its tensordicts: the same numbers with a sixth of the overhead."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule, SACLoss
from torchrl.objectives.utils import distance_loss
from torchrl.objectives.value import TD0Estimator

from coachable.distributions.tanh_normal import TanhGaussian
from coachable.fast.accelerate import Acceleration


class LeanSAC:
    """Evaluates a `SACLoss` on tensors, in the same order of random draws.

    On small batches the bookkeeping of tensordicts (copies, locks, parameter swaps) takes as long as a fifth of the
    matrix products. Any subclass of `SACLoss`, and whatever of its options is not covered here, is left to the loss.

    Args:
        loss_module: A loss for which :meth:`supports` holds.
        acceleration: Its accelerated networks; only inside `acceleration.active()` may this object be used.
    """

    def __init__(self, loss_module: LossModule, acceleration: Acceleration) -> None:
        loss: Any = loss_module
        self._loss, self._networks = loss, acceleration
        self._policy: nn.Module = loss.actor_network.module[0].module
        self._policy_keys = list(loss.actor_network.module[0].in_keys)
        self._critic_keys = list(loss.qvalue_network.in_keys)

    @staticmethod
    def supports(loss_module: LossModule) -> bool:
        """Whether this is `SACLoss` itself, with the mean reduction and a policy of `make_gaussian_actor`."""
        loss: Any = loss_module
        if type(loss_module) is not SACLoss or loss._version != 2 or loss.skip_done_states or loss.reduction != "mean":
            return False
        parts: list[Any] = list(loss.actor_network.module)
        return (
            len(parts) == 2
            and isinstance(parts[0], TensorDictModule)
            and isinstance(parts[0].module, nn.Module)
            and isinstance(parts[1], ProbabilisticTensorDictModule)
            and parts[1].distribution_class is TanhGaussian
            and not parts[1].distribution_kwargs
            and list(parts[0].out_keys) == ["loc", "scale"]
        )

    def serves(self, batch: TensorDictBase) -> bool:
        """Whether this batch asks for nothing special: no importance weights, no masks, a TD(0) target."""
        loss = self._loss
        estimator = loss.value_estimator
        if type(estimator) is not TD0Estimator or estimator.average_rewards:
            return False
        keys = batch.keys()
        weight = loss.tensor_keys.priority_weight
        if weight in keys and loss.use_prioritized_weights in (True, "auto"):
            return False
        return all(batch.get(key, None) is None for key in loss._loss_mask_keys())

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Both losses from the same parameters, as `SACLoss.forward`."""
        alpha = self._loss._alpha
        loss_qvalue, critic = self.critic_loss(batch, alpha)
        loss_actor, actor = self.actor_loss(batch, alpha)
        batch.set(self._loss.tensor_keys.priority, critic["td_error"])
        losses = {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "alpha": alpha,
            "entropy": -actor["log_prob"].mean(),
        }
        if self._loss.log_alpha.requires_grad:
            losses["loss_alpha"] = self._loss.alpha_loss(actor["log_prob"]).mean()
        return losses

    def actor_loss(self, batch: TensorDictBase, alpha: Tensor | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """`mean(alpha log pi - min_k Q_k)`, without gradient for the critics."""
        action, log_prob = self._act(batch)
        value = self._values(self._networks.frozen_critics, batch, action).min(0).values
        cost = (self._loss._alpha if alpha is None else alpha) * log_prob
        return (cost - value).mean(), {"log_prob": log_prob.detach()}

    def critic_loss(self, batch: TensorDictBase, alpha: Tensor | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """Regression on the target, summed over the critics."""
        target = self._target(batch, alpha)
        value = self._values(self._networks.trained_critics, batch, batch.get(self._loss.tensor_keys.action))
        loss = distance_loss(value, target.expand_as(value), loss_function=self._loss.loss_function)
        return loss.sum(0).mean(), {"td_error": (value.detach() - target).abs().amax(0)}

    @torch.no_grad()
    def _target(self, batch: TensorDictBase, alpha: Tensor | None = None) -> Tensor:
        keys, estimator = self._loss.tensor_keys, self._loss.value_estimator
        successor: Any = batch.get("next")
        action, log_prob = self._act(successor)
        value = self._values(self._networks.target_critics, successor, action).min(0).values
        value = value - (self._loss._alpha if alpha is None else alpha) * log_prob
        discount = estimator.gamma
        steps = batch.get(estimator.tensor_keys.steps_to_next_obs, None)
        if steps is not None:
            discount = discount ** steps.reshape(value.shape)
        terminated = successor.get(keys.terminated, None)
        if terminated is None:
            terminated = successor.get(keys.done)
        # Select rather than multiply: the successor of a terminal state may hold anything.
        bootstrap = torch.where(terminated.reshape(value.shape), 0.0, discount * value)
        return successor.get(keys.reward).reshape(value.shape) + bootstrap

    def _act(self, states: TensorDictBase) -> tuple[Tensor, Tensor]:
        loc, scale = self._policy(*(states.get(key) for key in self._policy_keys))
        return TanhGaussian(loc, scale).rsample_and_log_prob()

    def _values(self, critics: nn.Module, states: TensorDictBase, action: Tensor) -> Tensor:
        """Values `(K, ...)` of `action` in `states`."""
        name = self._loss.tensor_keys.action
        inputs = (action if key == name else states.get(key) for key in self._critic_keys)
        return critics(*inputs).squeeze(-1)
