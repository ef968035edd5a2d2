"""Distribution of mixed discrete-continuous actions: positive-part categorical heads and tanh-Gaussian axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution

from coachable.distributions.action_heads import ActionHeads
from coachable.distributions.categorical import (
    HeadLayout,
    categorical_entropy,
    hard_one_hots,
    log_probabilities,
    most_likely_one_hots,
    relaxed_one_hots,
)
from coachable.distributions.tanh_gaussian import (
    at_least_float32,
    sample_tanh_gaussian,
    tanh_gaussian_entropy,
    tanh_gaussian_log_prob,
)


class MixedAction(Distribution):
    """Distribution of one action tensor: the one-hots of independent categorical heads, then tanh-Gaussian axes.

    `sample` draws hard one-hots, which the environment executes, the replay buffer stores and targets use.
    `relaxed_action` is differentiable in every parameter; use it only in the policy loss. There is no `rsample` for
    categorical heads, so that no TorchRL component can draw relaxed actions by accident.

    Args:
        probs: Probabilities (..., heads.num_categorical); None without categorical heads.
        loc: Location of the axes before the tanh (..., heads.axes); None without axes.
        scale: Standard deviation of the axes before the tanh (..., heads.axes); None without axes.
        heads: Components of the action.

    Example:
        >>> heads = ActionHeads((2,), axes=1)
        >>> pi = MixedAction(torch.tensor([0.0, 1.0]), torch.zeros(1), torch.ones(1), heads=heads)
        >>> pi.sample().shape, pi.deterministic_sample.tolist()
        (torch.Size([3]), [0.0, 1.0, 0.0])
    """

    arg_constraints: dict = {}  # noqa: RUF012  # torch reads a class attribute

    def __init__(
        self, probs: Tensor | None = None, loc: Tensor | None = None, scale: Tensor | None = None, *, heads: ActionHeads
    ) -> None:
        if (probs is None) != (not heads.categorical) or (loc is None) != (not heads.axes):
            raise ValueError(f"give probs for categorical heads and loc and scale for axes, and only then: {heads}")
        self.heads = heads
        self.probs = None if probs is None else at_least_float32(probs)
        self.loc = None if loc is None else at_least_float32(loc)
        self.scale = None if scale is None else at_least_float32(scale)
        leading = self.probs if self.probs is not None else self.loc
        assert leading is not None  # ActionHeads has at least one component
        super().__init__(leading.shape[:-1], torch.Size((heads.action_dim,)), validate_args=False)

    @property
    def has_rsample(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether `rsample` is defined, which it is without categorical heads."""
        return not self.heads.categorical

    def relaxed_action(self) -> Tensor:
        """Draw a differentiable action (..., action_dim), with Gumbel-softmax one-hots at temperature 1."""
        return self._draw(relaxed_one_hots)

    def hard_action(self) -> Tensor:
        """Draw an exact action (..., action_dim) with hard one-hots, reparameterised in the axes only."""
        return self._draw(hard_one_hots)

    def relaxed_sample(self) -> tuple[Tensor, Tensor]:
        """Draw a `relaxed_action`, and return it and its log-density (...,), both differentiable.

        The density of the axes is exact. Categorical heads contribute the relaxed `sum_i y_i log pi_i` (our choice,
        because a one-sample estimate has no other gradient through a categorical sample).
        """
        return self._draw_and_score(relaxed_one_hots)

    def hard_sample(self) -> tuple[Tensor, Tensor]:
        """Draw a `hard_action`, and return it and its log-density (...,)."""
        return self._draw_and_score(hard_one_hots)

    def _draw(self, one_hots_of: Callable[[Tensor, HeadLayout], Tensor]) -> Tensor:
        one_hots = None if self.probs is None else one_hots_of(self.probs, self.heads.layout)
        axes = None
        if self.loc is not None and self.scale is not None:
            axes = torch.tanh(self.loc + self.scale * torch.randn_like(self.loc))
        return _joined(one_hots, axes)

    def _draw_and_score(self, one_hots_of: Callable[[Tensor, HeadLayout], Tensor]) -> tuple[Tensor, Tensor]:
        one_hots, axes = None, None
        log_prob: Tensor | float = 0.0
        if self.probs is not None:
            one_hots = one_hots_of(self.probs, self.heads.layout)
            log_prob = (one_hots * log_probabilities(self.probs)).sum(-1)
        if self.loc is not None and self.scale is not None:
            axes, density = sample_tanh_gaussian(self.loc, self.scale)
            log_prob = log_prob + density.sum(-1)
        return _joined(one_hots, axes), torch.as_tensor(log_prob)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw hard actions `(*sample_shape, ..., action_dim)` without gradient."""
        with torch.no_grad():
            return self._expanded(sample_shape).hard_action()

    def sample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Draw hard actions without gradient, with their differentiable log-densities `(*sample_shape, ...)`."""
        action = self.sample(sample_shape)
        return action, self.log_prob(action)

    def rsample(self, sample_shape: Sequence[int] = ()) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw reparameterised axes `(*sample_shape, ..., axes)`; see `rsample_and_log_prob`."""
        return self.rsample_and_log_prob(sample_shape)[0]

    def rsample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Draw reparameterised axes `(*sample_shape, ..., axes)`, with their log-densities `(*sample_shape, ...)`.

        Raises:
            NotImplementedError: If there are categorical heads.
        """
        if self.heads.categorical:
            raise NotImplementedError(
                "categorical heads have no reparameterised hard sample: use a loss that draws relaxed actions itself "
                "(RACLoss, CatRACLoss, CategoricalSACLoss), or sample()"
            )
        return self._expanded(sample_shape).hard_sample()

    def _expanded(self, sample_shape: Sequence[int]) -> MixedAction:
        if not len(sample_shape):
            return self
        parts = (None if p is None else p.expand(*sample_shape, *p.shape) for p in (self.probs, self.loc, self.scale))
        return MixedAction(*parts, heads=self.heads)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density (...,) of a given action with hard one-hots."""
        one_hots, axes = self.heads.split(value)
        log_prob: Tensor | float = 0.0
        if self.probs is not None:
            log_prob = (one_hots * log_probabilities(self.probs)).sum(-1)
        if self.loc is not None and self.scale is not None:
            log_prob = log_prob + tanh_gaussian_log_prob(axes, self.loc, self.scale).sum(-1)
        return torch.as_tensor(log_prob)

    def entropy_estimate(self, num_samples: int = 1000, shared_noise: bool = True) -> Tensor:
        """Return the sum of exact categorical entropies and sampled entropies of the axes (Appendix B).

        Args:
            num_samples: Number of draws per axis.
            shared_noise: Whether the states share their draws, see `tanh_gaussian_entropy`.

        Returns:
            Differentiable entropies (...,) [nat].
        """
        entropy: Tensor | float = 0.0
        if self.probs is not None:
            entropy = categorical_entropy(self.probs)
        if self.loc is not None and self.scale is not None:
            axes = tanh_gaussian_entropy(self.loc, self.scale, num_samples, shared_noise=shared_noise)
            entropy = entropy + axes.sum(-1)
        return torch.as_tensor(entropy)

    @property
    def deterministic_sample(self) -> Tensor:
        """Deterministic action: the most likely value of every head and the tanh of every axis's location."""
        one_hots = None if self.probs is None else most_likely_one_hots(self.probs, self.heads.layout)
        return _joined(one_hots, None if self.loc is None else torch.tanh(self.loc))

    @property
    def mode(self) -> Tensor:
        """Deterministic action `(..., action_dim)`, under the name that torch uses."""
        return self.deterministic_sample


def _joined(one_hots: Tensor | None, axes: Tensor | None) -> Tensor:
    return torch.cat([part for part in (one_hots, axes) if part is not None], -1)
