"""RAC, a soft actor-critic with one regulariser per action component (Appendix B)."""

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from coachable.distributions.mixed_action import MixedAction
from coachable.distributions.tanh_gaussian import at_least_float32
from coachable.losses.actor_critic import ActorCriticLoss
from coachable.ranges import COUNT


class RACLoss(ActorCriticLoss):
    """Loss of RAC with scalar critics, for mixed, purely continuous and purely categorical actions.

    `R(s) = -[sum of exact categorical entropies + sum of sampled entropies of the axes]` replaces the log-density of
    SAC's one sample:
    `L_pi = mean(alpha R - min_k Q_k(s, relaxed action))`,
    `y = r + gamma (1 - d)(min_k Q_k(s', hard action) - alpha R(s'))`,
    `L_Q = sum_k 1/2 mean (Q_k - y)^2`. The paper (Appendix B) gives R; the other terms are those of SAC.

    Args:
        actor_network: Policy, from `make_mixed_actor` or `make_gaussian_actor`.
        qvalue_network: List of critics.
        entropy_samples: Number of draws per axis for its entropy, independent of the action.
        shared_entropy_noise: Whether the states of a batch share these draws, which takes a third of the time, see
            `tanh_gaussian_entropy` (our choice).
        **options: See `ActorCriticLoss`.

    Raises:
        ValueError: If `entropy_samples` is not positive, and in the cases of `ActorCriticLoss`.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        entropy_samples: int = 1000,
        shared_entropy_noise: bool = True,
        **options: Any,
    ) -> None:
        COUNT.check("entropy_samples", entropy_samples)
        self.entropy_samples = int(entropy_samples)
        self.shared_entropy_noise = bool(shared_entropy_noise)
        super().__init__(actor_network, qvalue_network, **options)

    def _sample(self, policy: MixedAction, *, relaxed: bool) -> tuple[Tensor, Tensor]:
        action = policy.relaxed_action() if relaxed else policy.hard_action()
        return action, -policy.entropy_estimate(self.entropy_samples, self.shared_entropy_noise)

    def _values(self, output: Tensor) -> Tensor:
        return at_least_float32(output).squeeze(-1)

    def _errors(self, output: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        error = output.squeeze(-1) - target
        return 0.5 * error.square(), error.detach().abs()
