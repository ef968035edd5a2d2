"""Categorical SAC, the ablation of Cat-RAC's entropy estimate (Appendix D, ablation figure)."""

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule

from coachable.losses.actor_critic import ActorCriticLoss
from coachable.losses.cat_rac import CatRACLoss


class CategoricalSACLoss(CatRACLoss):
    """Loss of categorical SAC, with Cat-RAC's critic and SAC's one-sample entropy estimate (paper, ablation).

    The negative entropy is the log-density of the action drawn. The target uses that of the hard sample. In the policy
    loss categorical heads, whose hard samples have no gradient, contribute `sum_i y_i log pi_i` with the relaxed
    sample y (our choice). For RAC's estimators with fewer draws, use `CatRACLoss(entropy_samples=...)`.

    Args:
        actor_network: Policy, from `make_mixed_actor` or `make_gaussian_actor`.
        qvalue_network: List of critics with `num_atoms` outputs.
        **options: See `CatRACLoss`, without `entropy_samples` and `shared_entropy_noise`.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        **options: Any,
    ) -> None:
        for name in ("entropy_samples", "shared_entropy_noise"):
            if name in options:
                raise ValueError(
                    f"CategoricalSACLoss has no {name}: it estimates entropy from the action; use CatRACLoss"
                )
        super().__init__(actor_network, qvalue_network, **options)

    _sample = ActorCriticLoss._sample  # SAC's instead of RAC's
