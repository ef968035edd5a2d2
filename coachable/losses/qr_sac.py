"""QR-SAC: soft actor-critic with quantile critics (Appendix B; Wurman et al. 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from coachable.losses.actor_critic import ActorCriticLoss
from coachable.losses.functional import (
    QuantileReduction,
    TargetMin,
    bootstrap_target,
    pessimistic_quantiles,
    quantile_huber_loss,
)
from coachable.ranges import COUNT, NOT_NEGATIVE

EntropyInTarget = Literal["inside", "outside"]


class QRSACLoss(ActorCriticLoss):
    """Loss of QR-SAC for continuous actions; n-step returns come as rewards with `steps_to_next_obs`.

    Target `y_j = R + gamma^k (1 - d)(Z_j - alpha log pi(a'|s'))` with the quantiles Z of the target critic of lower
    mean; critic loss the quantile Huber loss of every prediction against every y_j, summed over critics; policy loss
    `mean(alpha log pi - min_c mean_i Z_ci)` (paper, Appendix B; Wurman et al. 2022). `td_error` is the absolute
    difference of the means of target and prediction.

    Args:
        actor_network: tanh-Gaussian policy, from `make_gaussian_actor`, or `make_mixed_actor` with axes only.
        qvalue_network: List of critics with `num_quantiles` outputs.
        num_quantiles: Quantiles per critic, M, at the levels `(2i - 1) / (2M)`.
        kappa: Where the Huber loss turns linear; 0 for the pinball loss.
        target_min: `"vector"`: all quantiles of the critic of lower mean. `"elementwise"`: minimum of each quantile.
        entropy_in_target: `"inside"`: in the bracket above. `"outside"`: `R + gamma^k (1 - d) Z_j - alpha log pi`,
            undiscounted and also at terminals, whose next observation must then be valid.
        quantile_reduction: `"mean"` over predictions and targets; `"sum"` over predictions, mean over targets.
        **options: See `ActorCriticLoss`.

    Raises:
        ValueError: If a number is out of range, an option unknown, or the actor has categorical heads.
    """

    _continuous_only = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_quantiles: int = 32,
        kappa: float = 1.0,
        target_min: TargetMin = "vector",
        entropy_in_target: EntropyInTarget = "inside",
        quantile_reduction: QuantileReduction = "mean",
        **options: Any,
    ) -> None:
        COUNT.check("num_quantiles", num_quantiles)
        NOT_NEGATIVE.check("kappa", kappa)
        for name, value, choices in (
            ("target_min", target_min, get_args(TargetMin)),
            ("entropy_in_target", entropy_in_target, get_args(EntropyInTarget)),
            ("quantile_reduction", quantile_reduction, get_args(QuantileReduction)),
        ):
            if value not in choices:
                raise ValueError(f"{name} must be one of {choices}, got {value!r}")
        self.num_quantiles = int(num_quantiles)
        self.kappa = float(kappa)
        self.target_min: TargetMin = target_min
        self.entropy_in_target: EntropyInTarget = entropy_in_target
        self.quantile_reduction: QuantileReduction = quantile_reduction
        super().__init__(actor_network, qvalue_network, **options)

    def _critic_width(self) -> int:
        return self.num_quantiles

    def _values(self, output: Tensor) -> Tensor:
        return output.to(torch.promote_types(output.dtype, torch.float32)).mean(-1)

    def _next_value(self, output: Tensor) -> Tensor:
        return pessimistic_quantiles(output, self.target_min)

    def _soft_target(
        self, reward: Tensor, next_value: Tensor, log_prob: Tensor, terminated: Tensor, steps: Tensor | None
    ) -> Tensor:
        if self.entropy_in_target == "inside":
            return super()._soft_target(reward, next_value, log_prob, terminated, steps)
        target = bootstrap_target(reward, next_value, terminated, self._gamma, steps)
        return target - self._alpha * log_prob.unsqueeze(-1)

    def _errors(self, output: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        losses = quantile_huber_loss(output, target, kappa=self.kappa, quantile_reduction=self.quantile_reduction)
        return losses, (target.mean(-1) - output.detach().mean(-1)).abs()
