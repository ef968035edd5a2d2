"""HL-Gauss: scalar targets as histograms of a Gaussian around them (Imani and White 2018; arXiv 2403.03950)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from coachable.distributions.tanh_gaussian import at_least_float32

# Logits of `initialise_value`: width of their bump over that of the support, and the lowest logit.
_INITIAL_WIDTH_RATIO = 1.0 / 40.0
_INITIAL_FLOOR = -8.0


class HLGauss:
    """Bins between v_min and v_max, with the encoding of scalars and the decoding of logits.

    Args:
        v_min: Smallest value represented.
        v_max: Largest value represented.
        num_atoms: Number of bins.
        sigma_ratio: Standard deviation of the Gaussian over the width of a bin.

    Raises:
        ValueError: If v_min >= v_max, num_atoms < 2, or sigma_ratio <= 0.

    Example:
        >>> bins = HLGauss(-600.0, 1000.0, 255)
        >>> p = bins.encode(torch.tensor([12.5]))
        >>> p.shape, round(bins.decode(p.log()).item(), 3)
        (torch.Size([1, 255]), 12.5)
    """

    def __init__(
        self, v_min: float = -600.0, v_max: float = 1000.0, num_atoms: int = 255, sigma_ratio: float = 0.75
    ) -> None:
        if not (math.isfinite(v_min) and math.isfinite(v_max) and v_min < v_max):
            raise ValueError(f"v_min must be less than v_max and both finite, got v_min={v_min}, v_max={v_max}")
        if int(num_atoms) != num_atoms or num_atoms < 2:
            raise ValueError(f"num_atoms must be an integer of at least 2, got {num_atoms}")
        if not (sigma_ratio > 0 and math.isfinite(sigma_ratio)):
            raise ValueError(f"sigma_ratio must be positive and finite, got {sigma_ratio}")
        self.v_min, self.v_max, self.num_atoms = float(v_min), float(v_max), int(num_atoms)
        self.sigma_ratio = float(sigma_ratio)
        self.bin_width = (self.v_max - self.v_min) / self.num_atoms
        self.sigma = self.sigma_ratio * self.bin_width
        self._constants: dict[tuple[torch.device, torch.dtype], tuple[Tensor, Tensor]] = {}

    def __repr__(self) -> str:
        return (
            f"HLGauss(v_min={self.v_min}, v_max={self.v_max}, num_atoms={self.num_atoms}, "
            f"sigma_ratio={self.sigma_ratio})"
        )

    def __deepcopy__(self, memo: dict) -> HLGauss:
        return HLGauss(self.v_min, self.v_max, self.num_atoms, self.sigma_ratio)

    def _edges_and_centres(self, like: Tensor) -> tuple[Tensor, Tensor]:
        # Computed in float64 and rounded once; cached to save kernel launches.
        key = (like.device, like.dtype)
        if key not in self._constants:
            with torch.inference_mode(False):  # a later training uses them, too
                index = torch.arange(self.num_atoms + 1, dtype=torch.float64, device=like.device)
                edges = self.v_min + self.bin_width * index
                centres = 0.5 * (edges[1:] + edges[:-1])
                self._constants[key] = (edges.to(like.dtype), centres.to(like.dtype))
        return self._constants[key]

    def edges(self, like: Tensor) -> Tensor:
        """Return the edges of the bins `(num_atoms + 1,)`, with the device and dtype of `like`."""
        return self._edges_and_centres(like)[0]

    def centres(self, like: Tensor) -> Tensor:
        """Return the centres of the bins `(num_atoms,)`, with the device and dtype of `like`."""
        return self._edges_and_centres(like)[1]

    def encode(self, value: Tensor) -> Tensor:
        """Return the probabilities of a Gaussian around each value, truncated to the support and renormalised.

        Values outside [v_min, v_max] are clamped first, because float32 gives 0/0 a few standard deviations outside.

        Args:
            value: Targets (...,).

        Returns:
            Probabilities (..., num_atoms), float32 or wider.
        """
        value = at_least_float32(value).clamp(self.v_min, self.v_max)
        # erf = 2 Phi - 1, whose factor of 2 cancels in the ratio.
        cumulative = torch.erf((self.edges(value) - value.unsqueeze(-1)) / (math.sqrt(2.0) * self.sigma))
        return cumulative.diff(dim=-1).div_(cumulative[..., -1:] - cumulative[..., :1])

    def decode(self, logits: Tensor) -> Tensor:
        """Return the mean of the distribution with the given logits.

        Args:
            logits: Logits (..., num_atoms).

        Returns:
            Values (...,) between the outer centres, float32 or wider.
        """
        return self.mean(at_least_float32(logits).softmax(-1))

    def mean(self, probabilities: Tensor) -> Tensor:
        """Return the mean (...,) of distributions over the bins (..., num_atoms)."""
        # Not a matrix product, which autocast would round to bfloat16.
        return (probabilities * self.centres(probabilities)).sum(-1)

    def cross_entropy(self, logits: Tensor, value: Tensor) -> Tensor:
        """Return the cross-entropy of `softmax(logits)` against the encoding of scalars.

        Args:
            logits: Logits (..., num_atoms), which may have leading dimensions that `value` lacks.
            value: Targets (...,), which get no gradient.

        Returns:
            Cross-entropies (...,) [nat], summed over bins.
        """
        return -(self.encode(value.detach()) * at_least_float32(logits).log_softmax(-1)).sum(-1)

    def clipped_fraction(self, value: Tensor) -> Tensor:
        """Return the fraction of values (any shape) outside [v_min, v_max], a scalar `()`."""
        return ((value < self.v_min) | (value > self.v_max)).to(at_least_float32(value).dtype).mean()


def initialise_value(critic: nn.Module, bins: HLGauss, initial_value: float | None = 0.0) -> None:
    """Make a new categorical critic predict `initial_value` for every input, in place.

    With its initial, almost uniform logits it would predict the middle of the support, +200 for the paper's.
    Bootstrapping takes tens of thousands of updates to correct that. The last linear layer is scaled by 0.01, and its
    bias becomes `-((centre - initial_value) / b)^2 / 2`, at least -8, where b is a fortieth of the support.

    Args:
        critic: Network whose last linear layer, in order of registration, has `bins.num_atoms` outputs.
        bins: The support.
        initial_value: Prediction; None does not change the network.

    Raises:
        ValueError: If the value lies outside the support, or the last linear layer has another width.
    """
    if initial_value is None:
        return
    if not bins.v_min <= initial_value <= bins.v_max:
        raise ValueError(f"initial_value must lie in [{bins.v_min}, {bins.v_max}], got {initial_value}")
    linears = [module for module in critic.modules() if isinstance(module, nn.Linear)]
    if not linears or linears[-1].out_features != bins.num_atoms or linears[-1].bias is None:
        found = linears[-1] if linears else None
        raise ValueError(
            f"the critic's last linear layer must have {bins.num_atoms} outputs and a bias, got {found}; "
            "see make_hl_gauss_critic"
        )
    with torch.no_grad():
        head = linears[-1]
        head.weight.mul_(0.01)
        distance = (bins.centres(head.weight) - initial_value) / (_INITIAL_WIDTH_RATIO * (bins.v_max - bins.v_min))
        head.bias.copy_((-0.5 * distance.square()).clamp_min(_INITIAL_FLOOR))
