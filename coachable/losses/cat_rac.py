"""Cat-RAC: RAC with a categorical critic trained on HL-Gauss encodings of its targets (Appendix B)."""

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from coachable.distributions.hl_gauss import HLGauss
from coachable.losses.rac import RACLoss


class CatRACLoss(RACLoss):
    """Loss of Cat-RAC, with the critic loss `L_Q = sum_k mean CE(HLGauss(y), softmax(logits_k))` over bins.

    The minimum over critics is that of the decoded means. `td_error` is the absolute difference of the target and the
    decoded mean. The metadata of `qvalue_loss` and the output of `forward` contain `clipped_fraction`, the share of
    targets outside the support (paper, Appendix B; Farebrother et al. 2024).

    Build the critics with `make_hl_gauss_critic`, so that their initial value is 0 instead of the middle of the
    support.

    Args:
        actor_network: Policy, from `make_mixed_actor` or `make_gaussian_actor`.
        qvalue_network: List of critics with `num_atoms` outputs.
        v_min: Smallest value represented.
        v_max: Largest value represented.
        num_atoms: Number of bins.
        sigma_ratio: Standard deviation of the target's Gaussian over the width of a bin.
        **options: See `RACLoss` and `ActorCriticLoss`.

    Raises:
        ValueError: If the support is empty or has fewer than two bins, or as `RACLoss`.
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | Sequence[TensorDictModule],
        *,
        v_min: float = -600.0,
        v_max: float = 1000.0,
        num_atoms: int = 255,
        sigma_ratio: float = 0.75,
        **options: Any,
    ) -> None:
        self.bins = HLGauss(v_min, v_max, num_atoms, sigma_ratio)
        super().__init__(actor_network, qvalue_network, **options)

    def critic_outputs(self) -> int:
        """Return the number of logits of one critic."""
        return self.bins.num_atoms

    def _values(self, output: Tensor) -> Tensor:
        return self.bins.decode(output)

    def _errors(self, output: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        value = self.bins.decode(output.detach())
        return self.bins.cross_entropy(output, target), (value - target).abs()

    def _extra_metrics(self, target: Tensor) -> dict[str, Tensor]:
        return {"clipped_fraction": self.bins.clipped_fraction(target)}
