"""Composable distributions over theta (paper, training distributions of the three domains; algorithms.md section 4).

Every sampler draws float32 of any batch shape from an optional `torch.Generator`. Draws happen on the generator's device
(on `device` without one) and the result is moved to `device`. Each call consumes the same random numbers whatever
it returns, so two runs with one seed stay aligned.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import torch
from torch import Generator, Tensor

_REGISTRY: dict[str, type["Sampler"]] = {}


@lru_cache(maxsize=256)
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    """A float32 constant on a device; shared, so never written to."""
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=torch.float32, device=device)


def _numbers(values: float | Sequence[float]) -> tuple[float, ...]:
    if isinstance(values, Tensor):
        values = values.tolist()
    return tuple(float(v) for v in values) if isinstance(values, Sequence) else (float(values),)


class Sampler:
    """Distribution over a block of `dim` style numbers.

    A new sampler is a frozen dataclass that subclasses this and defines `dim`, `_draw` and, for the range check of
    `StyleSpace`, `support`. Its fields must be numbers, strings, samplers or tuples of these: serialisation follows from them.
    """

    dim: int

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        _REGISTRY[cls.__name__] = cls

    def sample(
        self,
        shape: Sequence[int] = (),
        generator: Generator | None = None,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draws styles.

        Args:
            shape: Batch shape.
            generator: Source of randomness; torch's global generator if None.
            device: Device of the result; the generator's device if None, or the CPU without one.

        Returns:
            `(*shape, dim)` float32.
        """
        target = torch.device(device) if device is not None else generator.device if generator is not None else _CPU
        source = generator.device if generator is not None else target
        drawn = self._draw(tuple(shape), generator, source)
        return drawn if source == target else drawn.to(target)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__} must define _draw")

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Lowest and highest value of each entry, or None if not known."""
        return None

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready description; `Sampler.from_dict` reads it back."""
        return {"type": type(self).__name__, **{f.name: _plain(getattr(self, f.name)) for f in fields(self)}}  # type: ignore[arg-type]

    @staticmethod
    def from_dict(description: dict[str, Any]) -> "Sampler":
        """Rebuilds a sampler from `to_dict`.

        Raises:
            ValueError: If the type is unknown, for instance because the module that defines it was not imported.
        """
        arguments = dict(description)
        kind = arguments.pop("type", None)
        if kind not in _REGISTRY:
            raise ValueError(
                f"unknown sampler type {kind!r}: expected one of {sorted(_REGISTRY)}. "
                "A sampler of your own is known once its module has been imported."
            )
        return _REGISTRY[kind](**{name: _revived(value) for name, value in arguments.items()})


_CPU = torch.device("cpu")


def _plain(value: Any) -> Any:
    if isinstance(value, Sampler):
        return value.to_dict()
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _revived(value: Any) -> Any:
    if isinstance(value, dict):
        return Sampler.from_dict(value)
    return tuple(_revived(v) for v in value) if isinstance(value, list) else value


def _check_bounds(who: str, low: tuple[float, ...], high: tuple[float, ...]) -> None:
    if len(low) != len(high) or not low or not all(a <= b for a, b in zip(low, high, strict=True)):
        raise ValueError(f"{who} has low {low} and high {high}: expected equal lengths and low <= high throughout.")


def _rand(shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
    return torch.rand(shape, generator=generator, device=device, dtype=torch.float32)


def _one_hot(n: int, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
    """Boolean one-hot of a uniformly drawn index, `(*shape, n)`."""
    index = torch.randint(n, (*shape, 1), generator=generator, device=device)
    return index == torch.arange(n, device=device)


@dataclass(frozen=True)
class PointMass(Sampler):
    """Always the same style.

    Args:
        values: One number per entry, or a single number for one entry.

    Examples:
        >>> PointMass([0.0, 1.0]).sample((2,))
        tensor([[0., 1.],
                [0., 1.]])
    """

    values: tuple[float, ...]

    def __init__(self, values: float | Sequence[float]) -> None:
        object.__setattr__(self, "values", _numbers(values))

    @property
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return len(self.values)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return _constant(self.values, device).expand(*shape, self.dim).clone()

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The point itself, twice."""
        return self.values, self.values


@dataclass(frozen=True)
class Uniform(Sampler):
    """Independent entries, each uniform over its own range.

    Args:
        low: Lower bounds, one per entry, or a single number.
        high: Upper bounds, as many.

    Raises:
        ValueError: If lengths differ or a lower bound exceeds its upper bound.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __init__(self, low: float | Sequence[float], high: float | Sequence[float]) -> None:
        object.__setattr__(self, "low", _numbers(low))
        object.__setattr__(self, "high", _numbers(high))
        _check_bounds("Uniform", self.low, self.high)

    @property
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return len(self.low)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        # lerp, unlike low + u * (high - low), never rounds to a value outside [low, high].
        u = _rand((*shape, self.dim), generator, device)
        return torch.lerp(_constant(self.low, device), _constant(self.high, device), u)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The bounds."""
        return self.low, self.high


@dataclass(frozen=True)
class Mixture(Sampler):
    """Draws from one of several samplers, chosen with fixed probabilities, for each style separately.

    Args:
        components: Samplers of one dimension.
        weights: Their probabilities, summing to 1.

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
        object.__setattr__(self, "weights", _numbers(weights))
        dims = [c.dim for c in self.components]
        if not dims or len(set(dims)) != 1:
            raise ValueError(
                f"Mixture has components of dimensions {dims}: expected at least one, all of one dimension."
            )
        if len(self.weights) != len(dims) or min(self.weights) < 0 or abs(sum(self.weights) - 1.0) > 1e-6:
            raise ValueError(
                f"Mixture has weights {self.weights}, summing to {sum(self.weights)}: "
                f"expected {len(dims)} probabilities that sum to 1."
            )

    @property
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return self.components[0].dim

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        u = _rand((*shape, 1), generator, device)
        drawn = self.components[0]._draw(shape, generator, device)
        passed = 0.0
        for component, weight in zip(self.components[1:], self.weights, strict=False):
            passed += weight
            drawn = torch.where(u >= passed, component._draw(shape, generator, device), drawn)
        return drawn

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Hull of the components with a positive weight."""
        parts = [c.support() for c, w in zip(self.components, self.weights, strict=True) if w > 0]
        known = [p for p in parts if p is not None]
        if len(known) < len(parts):
            return None
        lows, highs = zip(*known, strict=True)
        return tuple(map(min, zip(*lows, strict=True))), tuple(map(max, zip(*highs, strict=True)))


@dataclass(frozen=True)
class Product(Sampler):
    """Independent samplers side by side; dimensions add up.

    Args:
        components: Samplers of consecutive blocks of theta.

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
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return sum(c.dim for c in self.components)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return torch.cat([c._draw(shape, generator, device) for c in self.components], dim=-1)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Supports of the components, concatenated."""
        parts = [c.support() for c in self.components]
        known = [p for p in parts if p is not None]
        if len(known) < len(parts):
            return None
        return sum((p[0] for p in known), ()), sum((p[1] for p in known), ())


@dataclass(frozen=True)
class UniformChoice(Sampler):
    """One-hot vector of a uniformly drawn option, for a `Choice`.

    Args:
        n: Number of options.
    """

    n: int

    def __post_init__(self) -> None:
        if self.n < 1:
            raise ValueError(f"UniformChoice has n = {self.n}: expected at least one option.")

    @property
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return self.n

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return _one_hot(self.n, shape, generator, device).to(torch.float32)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Zero to one."""
        return (0.0,) * self.n, (1.0,) * self.n


@dataclass(frozen=True)
class ContinuousOneHot(Sampler):
    """One uniformly drawn entry k is uniform over `[low_k, high_k]`, the rest are zero (paper, combat).

    Args:
        low: Lower bounds, one per entry.
        high: Upper bounds, as many.

    Raises:
        ValueError: If lengths differ or a lower bound exceeds its upper bound.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __init__(self, low: float | Sequence[float], high: float | Sequence[float]) -> None:
        object.__setattr__(self, "low", _numbers(low))
        object.__setattr__(self, "high", _numbers(high))
        _check_bounds("ContinuousOneHot", self.low, self.high)

    @property
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return len(self.low)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        hot = _one_hot(self.dim, shape, generator, device)
        # One number per style is enough: only the chosen entry uses it.
        u = _rand((*shape, 1), generator, device)
        values = torch.lerp(_constant(self.low, device), _constant(self.high, device), u)
        return torch.where(hot, values, 0.0)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The bounds, widened to contain zero."""
        return tuple(min(a, 0.0) for a in self.low), tuple(max(b, 0.0) for b in self.high)


@dataclass(frozen=True)
class OneHot(Sampler):
    """One uniformly drawn entry k takes the value `values_k`, the rest are zero (ablation of `ContinuousOneHot`).

    Args:
        values: Value of each entry when it is chosen.
    """

    values: tuple[float, ...]

    def __init__(self, values: float | Sequence[float]) -> None:
        object.__setattr__(self, "values", _numbers(values))

    @property
    def dim(self) -> int:  # type: ignore[override]
        """Number of entries."""
        return len(self.values)

    def _draw(self, shape: tuple[int, ...], generator: Generator | None, device: torch.device) -> Tensor:
        return torch.where(_one_hot(self.dim, shape, generator, device), _constant(self.values, device), 0.0)

    def support(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Zero to the value."""
        return tuple(min(v, 0.0) for v in self.values), tuple(max(v, 0.0) for v in self.values)
