"""Gradients of TorchRL's `SACLoss` without its tensordicts and without autograd, each thread on its rows of the batch.

With networks of 3 x 256 units, an update through `SACLoss` spends a third of its time in Python between the networks'
passes, where further threads cannot help. Here a thread computes everything for its rows from the networks' inputs to
their gradients, so that the threads meet once per update.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule, SACLoss
from torchrl.objectives.value import TD0Estimator

from coachable.distributions.tanh_normal import TanhGaussian
from coachable.fast.crew import crew_size, share_out
from coachable.fast.fused import Plan
from coachable.fast.passes import TorchPasses
from coachable.fast.workspace import Workspace
from coachable.networks.actors import GaussianPolicy
from coachable.networks.critics import StyleCritic

__all__ = ["DirectSAC", "Share", "has_direct_gradients"]

_FEWEST_ROWS = 32  # of a share


def has_direct_gradients(loss_module: LossModule) -> bool:
    """Return whether a loss is a `SACLoss` with the options and networks that :class:`DirectSAC` computes."""
    loss: Any = loss_module
    if type(loss) is not SACLoss or len(loss.actor_network) != 2:
        return False
    module, head = loss.actor_network
    estimator, critic = loss.value_estimator, loss.qvalue_network.module
    return (
        loss._version == 2
        and loss.loss_function == "l2"
        and loss.reduction == "mean"
        and not loss.skip_done_states
        and loss.min_log_alpha is None
        and loss.max_log_alpha is None
        and type(estimator) is TD0Estimator
        and not estimator.average_rewards
        and type(getattr(module, "module", None)) is GaussianPolicy
        and getattr(head, "distribution_class", None) is TanhGaussian
        and not head.distribution_kwargs
        and type(critic) is StyleCritic
        and critic.trunk.out_features == 1
    )


@dataclass(frozen=True)
class Share:
    """Networks for one thread's rows of a batch.

    Attributes:
        actor: Plan of the policy.
        critic: Plan of the critics.
        target: Plan of the target critics.
        gradients: Where the gradients of the policy and of the critics go, as one vector each.
    """

    actor: Plan
    critic: Plan
    target: Plan
    gradients: dict[str, Tensor]


@dataclass(frozen=True)
class _States:
    """Inputs of the networks at states, each `(rows, width)`; the critics' action follows their other inputs."""

    policy: list[Tensor]
    critic: list[Tensor]

    def part(self, rows: slice) -> _States:
        return _States([x[rows] for x in self.policy], [x[rows] for x in self.critic])


class DirectSAC:
    """Losses of a `SACLoss` with their gradients.

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
        """Return whether the batch has no weights of a prioritised replay buffer."""
        return self._loss._maybe_get_priority_weight(batch) is None

    def both(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Return what `SACLoss.forward` returns, after the gradients of policy, critics and temperature are set."""
        critic, actor = self._critic_work(batch), self._actor_work(batch)

        def work(share: Share, rows: slice) -> tuple[Tensor, Tensor, Tensor]:
            return critic(share, rows), *actor(share, rows)

        errors, log_prob, value = self._share_out(work, batch, "actor", "critic")
        loss_qvalue, td_error = self._critic_loss(errors, batch)
        loss_actor, log_prob = self._actor_loss(log_prob, value, batch)
        loss_alpha = self._loss._alpha_loss(log_prob).mean()
        if loss_alpha.requires_grad:
            loss_alpha.backward()
        batch.set(self._loss.tensor_keys.priority, td_error)
        return {
            "loss_actor": loss_actor,
            "loss_qvalue": loss_qvalue,
            "loss_alpha": loss_alpha.detach(),
            "alpha": self._loss._alpha,
            "entropy": -log_prob.mean(),
        }

    def critic(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the critics' loss and `td_error`, after their gradients are set."""
        work = self._critic_work(batch)
        (errors,) = self._share_out(lambda share, rows: (work(share, rows),), batch, "critic")
        loss, td_error = self._critic_loss(errors, batch)
        return loss, {"td_error": td_error}

    def actor(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the policy's loss and `log_prob`, after its gradients are set."""
        log_prob, value = self._share_out(self._actor_work(batch), batch, "actor")
        loss, log_prob = self._actor_loss(log_prob, value, batch)
        return loss, {"log_prob": log_prob}

    def _share_out(
        self, work: Callable[[Share, slice], tuple[Tensor, ...]], batch: TensorDictBase, *trained: str
    ) -> list[Tensor]:
        """Do the work for all rows of a batch, add up the gradients, and return the results of all rows.

        Args:
            work: Maps a share and its rows to results `(..., rows)`, and sets the gradients.
            batch: The batch.
            trained: Names of the gradients that the work sets.
        """
        count = batch.numel()
        threads = min(crew_size(), max(1, count // _FEWEST_ROWS))
        while len(self._shares) < threads:
            self._shares.append(self._make_share())
        shares, results = self._shares[:threads], [()] * threads
        cuts = pairwise(count * i // threads for i in range(threads + 1))

        def one(i: int, share: Share, rows: slice) -> None:
            with torch.no_grad():
                results[i] = work(share, rows)

        share_out([partial(one, i, s, slice(*cut)) for i, (s, cut) in enumerate(zip(shares, cuts, strict=True))])
        first, *others = shares
        for name in trained:
            for other in others:
                first.gradients[name].add_(other.gradients[name])
        return [torch.cat(parts, -1) if others else parts[0] for parts in zip(*results, strict=True)]

    def _critic_work(self, batch: TensorDictBase) -> Callable[[Share, slice], Tensor]:
        """Return what sets the critics' gradients and returns their errors `(K, rows)`."""
        loss, successor = self._loss, batch.get("next")
        estimator, keys = loss.value_estimator, loss.value_estimator.tensor_keys
        alpha, count = float(loss._alpha), batch.numel()
        states, next_states, noise = self._states(batch), self._states(successor), self._noise(count)
        taken = batch.get(loss.tensor_keys.action).reshape(count, -1)
        reward, terminated = successor.get(keys.reward).view(-1), successor.get(keys.terminated).view(-1)
        steps = batch.get(keys.steps_to_next_obs, None)
        discount = estimator.gamma if steps is None else (estimator.gamma**steps).view(-1)
        discount = discount * ~terminated

        def work(share: Share, rows: slice) -> Tensor:
            near, far = states.part(rows), next_states.part(rows)
            outputs, passes = _evaluate(share.actor, far.policy, keep=False)
            share.actor.release(passes)
            action, log_prob = self._sample(*self._parameters(outputs[0])[:2], noise[rows])
            values, passes = _evaluate(share.target, [*far.critic, action], keep=False)
            share.target.release(passes)
            next_value = values.squeeze(-1).amin(0).sub_(log_prob, alpha=alpha)
            target = torch.addcmul(reward[rows], discount[rows], next_value)
            values, passes = _evaluate(share.critic, [*near.critic, taken[rows]], keep=True)
            errors = values.squeeze(-1) - target
            _differentiate(share.critic, passes, errors.unsqueeze(-1) * (2.0 / count))
            return errors

        return work

    def _actor_work(self, batch: TensorDictBase) -> Callable[[Share, slice], tuple[Tensor, Tensor]]:
        """Return what sets the policy's gradients and returns log-densities and values `(rows,)` of its actions."""
        alpha, count = float(self._loss._alpha), batch.numel()
        states, every_noise = self._states(batch), self._noise(count)
        low, high = self._policy.log_scale_range

        def work(share: Share, rows: slice) -> tuple[Tensor, Tensor]:
            here, noise = states.part(rows), every_noise[rows]
            outputs, passes = _evaluate(share.actor, here.policy, keep=True)
            loc, scale, squashed = self._parameters(outputs[0])
            action, log_prob = self._sample(loc, scale, noise)
            values, critic_passes = _evaluate(share.critic, [*here.critic, action], keep=True)
            value, lowest = values.squeeze(-1).min(0)
            grads = torch.zeros_like(values).scatter_(0, lowest.view(1, -1, 1), -1.0 / count)
            start = sum(entry.shape[-1] for entry in here.critic)
            by_action = critic_passes.backward(grads, False, False, slice(start, start + action.shape[-1]))
            assert by_action is not None
            share.critic.release(critic_passes)
            by_action = by_action.to(action.dtype)
            # The derivative of the log-density is 2 tanh(u) with respect to u, and -1 / scale besides.
            by_loc = torch.addcmul(by_action, by_action * action, action, value=-1.0)
            by_loc.add_(action, alpha=2.0 * alpha / count)
            by_scale = (by_loc * noise).sub_(scale.reciprocal(), alpha=alpha / count)
            by_raw = by_scale.mul_(scale).mul_(0.5 * (high - low)).mul_(1.0 - squashed.square())
            _differentiate(share.actor, passes, torch.cat((by_loc, by_raw), -1).unsqueeze(0))
            return log_prob, value

        return work

    @staticmethod
    def _critic_loss(errors: Tensor, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        return errors.square().sum(0).mean(), errors.abs().amax(0).view(batch.batch_size)

    def _actor_loss(self, log_prob: Tensor, value: Tensor, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        return (self._loss._alpha * log_prob - value).mean(), log_prob.view(batch.batch_size)

    def _states(self, batch: TensorDictBase) -> _States:
        loss = self._loss
        observation, *style = loss.actor_network.in_keys
        policy = self._inputs(self._policy, batch, observation, style)
        observation, _, *style = loss.qvalue_network.in_keys
        return _States(policy, self._inputs(self._value, batch, observation, style))

    def _noise(self, rows: int) -> Tensor:
        bias = self._loss.actor_network_params["module", "0", "module", "trunk", "head", "bias"]
        return torch.randn(rows, len(bias) // 2, dtype=bias.dtype)

    @staticmethod
    def _inputs(
        network: GaussianPolicy | StyleCritic, batch: TensorDictBase, observation: Any, style: Any
    ) -> list[Tensor]:
        inputs = [batch.get(observation)]
        if network.space is not None:
            inputs.append(network.space.encode(batch.get(style[0])))
        return [entry.reshape(-1, entry.shape[-1]) for entry in inputs]

    def _parameters(self, output: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return location, scale, and the tanh inside the scale, as :class:`GaussianPolicy` computes them."""
        loc, raw = output.chunk(2, -1)
        low, high = self._policy.log_scale_range
        squashed = torch.tanh(raw)
        return loc, torch.exp(squashed * (0.5 * (high - low)) + 0.5 * (high + low)), squashed

    @staticmethod
    def _sample(loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions and their log-densities, as :class:`TanhGaussian` computes them."""
        u = torch.addcmul(loc, scale, noise)
        score = F.softplus(-2.0 * u).add_(u).mul_(2.0).sub_(torch.log(scale)).addcmul_(noise, noise, value=-0.5)
        constant = loc.shape[-1] * (0.5 * math.log(2.0 * math.pi) + 2.0 * math.log(2.0))
        return torch.tanh(u), score.sum(-1).sub_(constant)


def _evaluate(plan: Plan, inputs: list[Tensor], keep: bool) -> tuple[Tensor, Workspace | TorchPasses]:
    """Return the outputs `(K, rows, out)` of the members of a plan, and what their backward pass needs."""
    rows = len(inputs[0])
    passes = plan.acquire([entry.shape[-1] for entry in inputs], rows, keep)
    dtype = plan.members[0].parameters[-1].dtype
    out = torch.empty(len(plan.members), rows, plan.out_features, dtype=dtype)
    passes.forward(inputs, out.unbind())
    return out, passes


def _differentiate(plan: Plan, passes: Workspace | TorchPasses, grads: Tensor) -> None:
    passes.backward(grads, True, False, None)
    plan.written = True
    plan.release(passes)
