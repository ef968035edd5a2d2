"""QR-SAC: soft actor-critic with quantile critics (Appendix B; Wurman et al. 2022)."""

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from coachable.distributions.tanh_gaussian import at_least_float32
from coachable.losses.actor_critic import ActorCriticLoss
from coachable.losses.functional import pessimistic_quantiles, quantile_huber_loss
from coachable.ranges import COUNT, NOT_NEGATIVE


class QRSACLoss(ActorCriticLoss):
    """Loss of QR-SAC for continuous actions.

    The target is `y_j = R + gamma^k (1 - d)(Z_j - alpha log pi(a'|s'))` with the quantiles Z of the target critic of
    lower mean. The critic loss is the quantile Huber loss of every prediction against every y_j, summed over critics.
    The policy loss is `mean(alpha log pi - min_c mean_i Z_ci)` (paper, Appendix B; Wurman et al. 2022). `td_error` is
    the absolute difference of the means of target and prediction.

    Args:
        actor_network: Tanh-Gaussian policy, from `make_gaussian_actor`, or `make_mixed_actor` with axes only.
        qvalue_network: List of critics with `num_quantiles` outputs.
        num_quantiles: Number of quantiles per critic, M, at the levels `(2i - 1) / (2M)`.
        kappa: Error at which the Huber loss becomes linear; 0 for the pinball loss.
        **options: See `ActorCriticLoss`.

    Raises:
        ValueError: If a number is out of range or the actor has categorical heads.
    """

    _continuous_only = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        num_quantiles: int = 32,
        kappa: float = 1.0,
        **options: Any,
    ) -> None:
        COUNT.check("num_quantiles", num_quantiles)
        NOT_NEGATIVE.check("kappa", kappa)
        self.num_quantiles = int(num_quantiles)
        self.kappa = float(kappa)
        super().__init__(actor_network, qvalue_network, **options)

    def critic_outputs(self) -> int:
        """Return the number of quantiles of one critic."""
        return self.num_quantiles

    def _values(self, output: Tensor) -> Tensor:
        return at_least_float32(output).mean(-1)

    def _next_value(self, output: Tensor) -> Tensor:
        return pessimistic_quantiles(output)

    def _errors(self, output: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        losses = quantile_huber_loss(output, target, kappa=self.kappa)
        return losses, (target.mean(-1) - output.detach().mean(-1)).abs()
