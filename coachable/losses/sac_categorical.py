"""Categorical SAC, the ablation of Cat-RAC's entropy estimate (Appendix D, ablation figure)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from coachable.distributions.mixed_action import MixedAction
from coachable.losses.cat_rac import CatRACLoss


class CategoricalSACLoss(CatRACLoss):
    """Categorical SAC, the paper's ablation: Cat-RAC's critic with SAC's one-sample entropy estimate.

    The negative entropy is the log-density of the one action drawn. In the target that is the hard sample's. In the
    policy loss categorical heads, through whose samples no gradient passes, contribute `sum_i y_i log pi_i` with the
    relaxed sample y (our choice). For RAC's estimators with fewer draws use `CatRACLoss(entropy_samples=...)`.

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

    def _sample(self, policy: MixedAction, *, relaxed: bool) -> tuple[Tensor, Tensor]:
        return policy.relaxed_sample() if relaxed else policy.hard_sample()
