"""Composable distributions over theta (paper, Appendix A, Parameter Sampling).

Every sampler draws float32 of any batch shape from an optional `torch.Generator`. It draws on the generator's device,
or without one on `device`, and moves the result to `device`. The number of random numbers that a call uses depends only
on the batch shape, not on the values drawn, so that runs with equal seeds stay aligned.
"""

import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from coachable.ranges import COUNT, FINITE, SHARE
from coachable.styles.sampler_base import Sampler, constant, numbers


def _check_finite(sampler: Sampler, values: tuple[float, ...]) -> None:
    for value in values:
        FINITE.check(f"a value of {type(sampler).__name__}", value)


def _bounds_of(samplers: Iterable[Sampler]) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]] | None:
    """Return the lower and the upper bounds of several samplers, or None if those of a sampler are not known."""
    supports = [sampler.support() for sampler in samplers]
    known = [bounds for bounds in supports if bounds is not None]
    return None if len(known) < len(supports) else ([low for low, _ in known], [high for _, high in known])


def _rand(shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
    return torch.rand(shape, generator=generator, device=device, dtype=torch.float32)


def _one_hot(n: int, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
    """Draw an index uniformly and return it as a boolean one-hot `(*shape, n)`."""
    index = torch.randint(n, (*shape, 1), generator=generator, device=device)
    return index == torch.arange(n, device=device)


@dataclass(frozen=True)
class PointMass(Sampler):
    """Distribution that always gives the same style.

    Args:
        values: One number per entry, or a single number for one entry.

    Examples:
        >>> PointMass([0.0, 1.0]).sample((2,))
        tensor([[0., 1.],
                [0., 1.]])
    """

    values: tuple[float, ...]

    def __init__(self, values: float | Sequence[float]) -> None:
        object.__setattr__(self, "values", numbers(values))
        _check_finite(self, self.values)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return constant(self.values, device).expand(*shape, len(self.values)).clone()

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the values as lower and as upper bounds."""
        return self.values, self.values


@dataclass(frozen=True)
class Uniform(Sampler):
    """Distribution of independent entries, each uniform over its own range.

    Args:
        low: Lower bounds, one per entry, or a single number.
        high: Upper bounds, in the same form.

    Raises:
        ValueError: If lengths differ or a lower bound exceeds its upper bound.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __init__(self, low: float | Sequence[float], high: float | Sequence[float]) -> None:
        object.__setattr__(self, "low", numbers(low))
        object.__setattr__(self, "high", numbers(high))
        _check_finite(self, self.low + self.high)
        if len(self.low) != len(self.high) or not self.low or any(map(operator.gt, self.low, self.high)):
            raise ValueError(
                f"{type(self).__name__} has low {self.low} and high {self.high}: expected equal lengths and low <= high"
            )

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        # lerp, because its rounded results are inside [low, high], as bounded specs require.
        u = _rand((*shape, len(self.low)), generator, device)
        return torch.lerp(constant(self.low, device), constant(self.high, device), u)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the bounds."""
        return self.low, self.high


@dataclass(frozen=True)
class Mixture(Sampler):
    """Distribution that draws each style from one of several samplers, chosen with fixed probabilities.

    Args:
        components: Samplers of the same dimension.
        weights: Their probabilities, with sum 1.

    Raises:
        ValueError: If dimensions differ, or the weights are negative or do not sum to 1.

    Examples:
        >>> drift = Mixture([PointMass(0.0), Uniform(-0.4, 0.0), Uniform(0.0, 5.0)], [0.5, 0.25, 0.25])
        >>> drift.sample((8,)).shape
        torch.Size([8, 1])
    """

    components: tuple[Sampler, ...]
    weights: tuple[float, ...]

    def __init__(self, components: Sequence[Sampler], weights: Sequence[float]) -> None:
        object.__setattr__(self, "components", tuple(components))
        object.__setattr__(self, "weights", numbers(weights))
        dims = [c.dim for c in self.components]
        if not dims or len(set(dims)) != 1:
            raise ValueError(
                f"Mixture has components of dimensions {dims}: expected at least one, all of one dimension."
            )
        fine = all(SHARE.holds(weight) for weight in self.weights) and abs(sum(self.weights) - 1.0) <= 1e-6
        if len(self.weights) != len(dims) or not fine:
            raise ValueError(
                f"Mixture has weights {self.weights}, summing to {sum(self.weights)}: "
                f"expected {len(dims)} probabilities that sum to 1."
            )

    @property
    def dim(self) -> int:
        """Number of entries."""
        return self.components[0].dim

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        u = _rand((*shape, 1), generator, device)
        drawn = self.components[0]._draw(shape, generator, device)
        passed = self.weights[0]
        for component, weight in zip(self.components[1:], self.weights[1:], strict=True):
            if weight > 0:
                drawn = torch.where(u >= passed, component._draw(shape, generator, device), drawn)
            passed += weight
        return drawn

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Return the bounds of the union of the components with a positive weight."""
        bounds = _bounds_of(c for c, w in zip(self.components, self.weights, strict=True) if w > 0)
        if bounds is None:
            return None
        lows, highs = bounds
        return tuple(map(min, zip(*lows, strict=True))), tuple(map(max, zip(*highs, strict=True)))


@dataclass(frozen=True)
class Product(Sampler):
    """Distribution of consecutive blocks of theta that are drawn independently.

    Args:
        components: Samplers of the blocks.

    Examples:
        >>> humanoid = Product([UniformChoice(3), Uniform(0.30, 0.65)])
        >>> humanoid.dim
        4
    """

    components: tuple[Sampler, ...]

    def __init__(self, components: Sequence[Sampler]) -> None:
        object.__setattr__(self, "components", tuple(components))
        if not self.components:
            raise ValueError("Product has no components: expected at least one sampler.")

    @property
    def dim(self) -> int:
        """Number of entries."""
        return sum(c.dim for c in self.components)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return torch.cat([c._draw(shape, generator, device) for c in self.components], dim=-1)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Return the bounds of the components, concatenated."""
        bounds = _bounds_of(self.components)
        return None if bounds is None else (sum(bounds[0], ()), sum(bounds[1], ()))


@dataclass(frozen=True)
class UniformChoice(Sampler):
    """Distribution of a one-hot vector with a uniformly drawn option, for a `Choice`.

    Args:
        n: Number of options.
    """

    n: int

    def __post_init__(self) -> None:
        COUNT.check("n of UniformChoice", self.n)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return _one_hot(self.n, shape, generator, device).to(torch.float32)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return bounds of 0 and 1."""
        return (0.0,) * self.n, (1.0,) * self.n


@dataclass(frozen=True, init=False)
class ContinuousOneHot(Uniform):
    """Distribution in which one uniformly drawn entry k is uniform over `[low_k, high_k]` and the others are 0 (paper).

    Args:
        low: Lower bounds, one per entry.
        high: Upper bounds, one per entry.

    Raises:
        ValueError: If lengths differ or a lower bound exceeds its upper bound.
    """

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        hot = _one_hot(len(self.low), shape, generator, device)
        # One number per style is enough, because only the chosen entry uses it.
        u = _rand((*shape, 1), generator, device)
        values = torch.lerp(constant(self.low, device), constant(self.high, device), u)
        return torch.where(hot, values, 0.0)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the bounds, widened to contain 0."""
        return tuple(min(a, 0.0) for a in self.low), tuple(max(b, 0.0) for b in self.high)


@dataclass(frozen=True, init=False)
class OneHot(PointMass):
    """Distribution in which one uniformly drawn entry k is `values_k` and the others are 0 (paper, ablation).

    Args:
        values: Value of each entry if it is drawn.
    """

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return torch.where(_one_hot(len(self.values), shape, generator, device), constant(self.values, device), 0.0)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the bounds of 0 and the value."""
        return tuple(min(v, 0.0) for v in self.values), tuple(max(v, 0.0) for v in self.values)


@dataclass(frozen=True)
class Shared(Sampler):
    """Distribution in which several rows of a batch, such as the cars of a race, share a style.

    In a batch `(copies * n,)` rows i, i + n, i + 2 n and so on share a style. A last axis of 1 in the shape, as
    `(n, 1)`, gives styles that are not shared, as relabelling needs.

    Args:
        sampler: Distribution of the shared style.
        copies: Number of rows that share a style.

    Raises:
        ValueError: If `copies` is below 1.

    Examples:
        >>> style = Shared(Uniform(0.0, 1.0), 3).sample((6,))
        >>> bool((style[:2] == style[4:]).all())
        True
    """

    sampler: Sampler
    copies: int

    def __post_init__(self) -> None:
        COUNT.check("copies", self.copies)

    @property
    def dim(self) -> int:
        """Number of entries."""
        return self.sampler.dim

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        if not shape:
            return self.sampler._draw(shape, generator, device)
        count = -(-shape[-1] // self.copies)
        drawn = self.sampler._draw((*shape[:-1], count), generator, device)
        return drawn.repeat(*(1 for _ in shape[:-1]), self.copies, 1)[..., : shape[-1], :].clone()

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Return the bounds of the shared style."""
        return self.sampler.support()
