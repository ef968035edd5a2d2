"""TorchRL's `TanhNormal` with a construction that costs nothing."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution, Normal
from torchrl.modules import TanhNormal

from coachable.networks.tanh_gaussian import sample_tanh_gaussian, tanh_gaussian_log_prob


class TanhGaussian(TanhNormal):
    """Distribution of `tanh(u)` with independent Gaussian `u`, on (-1, 1).

    The same distribution as `TanhNormal(loc, scale)`. Building that one takes 0.3 ms, more than sampling it, and a loss
    builds two per update. Scores are those of the pre-tanh value, exact also where tanh saturates.

    Args:
        loc: Location of u, `(..., A)`.
        scale: Standard deviation of u, `(..., A)`.

    Example:
        >>> action, log_prob = TanhGaussian(torch.zeros(5, 2), torch.ones(5, 2)).rsample_and_log_prob()
        >>> action.shape, log_prob.shape
        (torch.Size([5, 2]), torch.Size([5]))
    """

    has_rsample = True

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        self.loc, self.scale = loc, scale
        # TanhNormal's own constructor is what takes the time.
        Distribution.__init__(self, loc.shape[:-1], loc.shape[-1:], validate_args=False)

    def rsample_and_log_prob(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """Reparameterised action `(*sample_shape, ..., A)` and its log-density `(*sample_shape, ...)`."""
        action, log_prob = sample_tanh_gaussian(self.loc, self.scale, self._noise(sample_shape))
        return action, log_prob.sum(-1)

    def sample_and_log_prob(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> tuple[Tensor, Tensor]:
        """Detached action, and its log-density with the score-function gradient."""
        with torch.no_grad():
            u = self.loc + self.scale * self._noise(sample_shape)
        noise = (u - self.loc) / self.scale
        _, log_prob = sample_tanh_gaussian(u, self.scale, torch.zeros_like(u))
        return torch.tanh(u), (log_prob - 0.5 * noise.square()).sum(-1)

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Reparameterised action."""
        return torch.tanh(self.loc + self.scale * self._noise(sample_shape))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Action without gradient."""
        with torch.no_grad():
            return self.rsample(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density `(...,)` of actions that come from elsewhere."""
        return tanh_gaussian_log_prob(value, self.loc, self.scale).sum(-1)

    @property
    def deterministic_sample(self) -> Tensor:
        """Median, `tanh(loc)`."""
        return torch.tanh(self.loc)

    @property
    def root_dist(self) -> Normal:
        """Distribution of u."""
        return Normal(self.loc, self.scale)

    def expand(self, batch_shape: torch.Size | tuple[int, ...], _instance: None = None) -> TanhGaussian:
        """Repeat for a larger batch shape."""
        shape = (*batch_shape, *self.event_shape)
        return TanhGaussian(self.loc.expand(shape), self.scale.expand(shape))

    def update(self, loc: Tensor, scale: Tensor) -> None:
        """Replace the parameters."""
        self.__init__(loc, scale)

    def _noise(self, sample_shape: torch.Size | tuple[int, ...]) -> Tensor:
        shape = (*sample_shape, *self.loc.shape)
        return torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
