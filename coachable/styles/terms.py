"""Terms of the style reward: small callables with the names of the style parameters that they read.

A term maps `(features, style)` to a reward `(...,)`. `features` is the tensor `(..., F)` that the environment emitted,
`style` a mapping from parameter name to its block of theta.

The terms here use only elementwise operations, in a fixed order. A reduction such as `Tensor.sum` may add in another
order for another batch shape or memory layout, and the relabelled reward would differ in its last bits from the
collected one. On the CPU, PyTorch 2.13's elementwise `sigmoid`, `cosh`, `atan2` and `pow` with a fractional exponent
also give other bits for other layouts; `exp`, `log`, `tanh`, `sqrt`, `sin` and `cos` do not (measured).
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import ClassVar, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor, nn

from coachable.styles.parameters import Choice
from coachable.styles.space import StyleSpace
from coachable.styles.tolerance import tolerance
from coachable.styles.view import StyleView

Style: TypeAlias = Mapping[str, Tensor]


@runtime_checkable
class StyleTerm(Protocol):
    """Callable `(features, style) -> (...,)` with the names of the parameters that it reads.

    A term may also have `is_linear`, which is true if its reward is linear in the features, and `mismatch(space)`,
    which returns what is wrong with the parameters that it reads, or None.
    """

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the style parameters that it reads."""
        ...

    def __call__(self, features: Tensor, style: Style) -> Tensor:
        """Return the reward of the term, `(...,)`, before its scale."""
        ...


@dataclass(frozen=True)
class Term:
    """Term made from a plain function.

    Args:
        function: `(features, style) -> (...,)`.
        parameters: Names of the style parameters that the function reads.

    Examples:
        >>> term = Term(lambda features, style: style["fuel"] * features[..., 0], parameters=("fuel",))
        >>> term(torch.tensor([[2.0]]), {"fuel": torch.tensor([3.0])})
        tensor([6.])
    """

    function: Callable[[Tensor, Style], Tensor]
    parameters: tuple[str, ...]

    def __post_init__(self) -> None:
        parameters = (self.parameters,) if isinstance(self.parameters, str) else tuple(self.parameters)
        object.__setattr__(self, "parameters", parameters)

    def __call__(self, features: Tensor, style: Style) -> Tensor:
        """Call the function."""
        return self.function(features, style)


def feature(features: Tensor, key: int | slice) -> Tensor:
    """Return one feature or several.

    Args:
        features: Tensor `(..., F)`.
        key: Column, or a slice of columns.

    Returns:
        The feature `(...,)` for a column, and features `(..., k)` for a slice.

    Raises:
        KeyError: If there is no such column.
    """
    try:
        return features[..., key]
    except IndexError:
        raise KeyError(f"no style feature {key}: the environment emits {features.shape[-1]} columns.") from None


def weighted_sum(weights: Tensor, values: Tensor) -> Tensor:
    """Sum products over the last dimension, with the same bits for every batch shape, memory layout and device.

    Args:
        weights: Weights `(..., k)`.
        values: Values `(..., k)`, broadcastable with the weights.

    Returns:
        Sums `(...,)`.
    """
    # Unlike a reduction kernel, elementwise additions do not depend on strides or batch shape.
    return reduce(operator.add, (weights * values).unbind(-1))


class _OfNumbers:
    """Base of terms that read weights or set-points."""

    parameters: tuple[str, ...]

    def mismatch(self, space: StyleSpace) -> str | None:
        """Return what is wrong if a parameter of the term is a choice."""
        if not any(isinstance(space[name], Choice) for name in self.parameters):
            return None
        return f"is a {type(self).__name__} of a choice: expected ChoiceTolerance or Term"


@dataclass(frozen=True)
class WeightedFeature(_OfNumbers):
    """Term `w * g` of one weight and one feature.

    Args:
        parameter: Name of the `Weight`.
        key: Column of the feature.
    """

    parameter: str
    key: int
    is_linear: ClassVar[bool] = True

    @property
    def parameters(self) -> tuple[str, ...]:
        """Name of the weight, as a tuple."""
        return (self.parameter,)

    def __call__(self, features: Tensor, style: Style) -> Tensor:
        """Return the reward `(...,)`."""
        weight = style[self.parameter]
        return weight * feature(features, self.key)


class WeightedSum(_OfNumbers):
    """Term `sum_i w_i g_i` of many weights, where `features[..., i]` belongs to `parameters[i]` (paper, combat).

    With 18 weights, one such term is much faster than 18 of `WeightedFeature`.

    Args:
        parameters: Names of the weights, in the order of the features.
        key: Columns of the features, as many as parameters; all by default.
    """

    is_linear = True

    def __init__(self, parameters: Sequence[str], key: slice = slice(None)) -> None:
        self.parameters = tuple(parameters)
        self.key = key

    def __call__(self, features: Tensor, style: Style) -> Tensor:
        """Return the reward `(...,)`."""
        if isinstance(style, StyleView):
            weights = style.block(self.parameters)
        else:
            weights = torch.stack([style[name] for name in self.parameters], dim=-1)
        values = feature(features, self.key)
        if values.shape[-1] != len(self.parameters):
            raise ValueError(
                f"WeightedSum reads {values.shape[-1]} features for {len(self.parameters)} weights {self.parameters}: "
                "expected as many, in the same order. Pass `key` to select them."
            )
        return weighted_sum(weights, values)


@dataclass(frozen=True)
class SetpointTolerance(_OfNumbers):
    """Term that is the `tolerance` of a feature around a set-point: 1 at the requested value.

    Args:
        parameter: Name of the `Setpoint`.
        key: Column of the measured feature, in the unit of the set-point.
        margin: Distance at which the reward is `value_at_margin`, in the same unit.
        sigmoid: Shape of the decline, see `tolerance`.
        value_at_margin: See `tolerance`.
        gate: Column of a feature that multiplies the term, such as a "step completed" flag, or None.

    Raises:
        ValueError: If `margin`, `sigmoid` or `value_at_margin` is not valid for `tolerance`.
    """

    parameter: str
    key: int
    margin: float
    sigmoid: str = "long_tail"
    value_at_margin: float = 0.1
    gate: int | None = None

    def __post_init__(self) -> None:
        _check_shape(self.margin, self.sigmoid, self.value_at_margin)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Name of the set-point, as a tuple."""
        return (self.parameter,)

    def __call__(self, features: Tensor, style: Style) -> Tensor:
        """Return the reward `(...,)`."""
        target = style[self.parameter]
        measured = feature(features, self.key)
        value = tolerance(measured, target, target, self.margin, self.sigmoid, self.value_at_margin)
        return value if self.gate is None else value * feature(features, self.gate).to(value.dtype)


class ChoiceTolerance:
    """Term that is the mean `tolerance` of several features in bounds that depend on an option (paper, arm poses).

    Args:
        parameter: Name of the `Choice`.
        key: Columns of the k features, a slice also if k is 1.
        lower: Lower bounds `(n_options, k)`, in the unit of the features.
        upper: Upper bounds `(n_options, k)`.
        margin: Distance at which the value is `value_at_margin`, in the same unit.
        sigmoid: Shape of the decline, see `tolerance`.
        value_at_margin: See `tolerance`.

    Raises:
        ValueError: If the bounds are not two matrices of one shape, a lower bound exceeds its upper bound, the key is
            an index, or a setting is not valid for `tolerance`.
    """

    def __init__(
        self,
        parameter: str,
        key: slice,
        lower: Tensor,
        upper: Tensor,
        margin: float,
        sigmoid: str = "long_tail",
        value_at_margin: float = 0.1,
    ) -> None:
        lower, upper = torch.as_tensor(lower, dtype=torch.float32), torch.as_tensor(upper, dtype=torch.float32)
        if lower.ndim != 2 or lower.shape != upper.shape or bool((lower > upper).any()):
            raise ValueError(
                f"ChoiceTolerance for {parameter!r} has bounds of shapes {tuple(lower.shape)}, {tuple(upper.shape)}: "
                "expected two (n_options, k) matrices with lower <= upper."
            )
        if isinstance(key, int):
            raise ValueError(
                f"ChoiceTolerance for {parameter!r} has the key {key}, an index: expected a slice, such as slice(0, 1) "
                "for the first feature."
            )
        _check_shape(margin, sigmoid, value_at_margin)
        self.parameters, self.num_options = (parameter,), len(lower)
        self.key, self.margin, self.sigmoid, self.value_at_margin = key, margin, sigmoid, value_at_margin
        # Both bounds are in one table (n_options, 2k), so that a step needs one look-up instead of two.
        self._bounds = {lower.device: torch.cat([lower, upper], dim=-1)}
        self._mean = {lower.device: torch.full((lower.shape[1],), 1.0 / lower.shape[1], device=lower.device)}

    def mismatch(self, space: StyleSpace) -> str | None:
        """Return what is wrong if the parameter has another number of options than the bounds."""
        [name] = self.parameters
        width = space[name].width
        return f"has bounds for {self.num_options} options, {name} has {width}" if width != self.num_options else None

    def __call__(self, features: Tensor, style: Style) -> Tensor:
        """Return the reward `(...,)`."""
        measured, option = feature(features, self.key), style[self.parameters[0]].argmax(-1)
        table, mean = _on(self._bounds, option.device), _on(self._mean, option.device)
        lower, upper = nn.functional.embedding(option, table).chunk(2, dim=-1)  # (..., k) each
        if measured.shape[-1:] != mean.shape:
            raise ValueError(
                f"ChoiceTolerance for {self.parameters[0]!r} reads {measured.shape[-1]} features by key {self.key}: "
                f"expected {len(mean)}, one for each column of its bounds."
            )
        value = tolerance(measured, lower, upper, self.margin, self.sigmoid, self.value_at_margin)
        return weighted_sum(mean, value)


def _check_shape(margin: float, sigmoid: str, value_at_margin: float) -> None:
    tolerance(torch.zeros(1), 0.0, 0.0, margin, sigmoid, value_at_margin)


def _on(copies: dict[torch.device, Tensor], device: torch.device) -> Tensor:
    """Return a constant's copy on a device, which is made lazily."""
    found = copies.get(device)
    if found is None:
        found = copies[device] = next(iter(copies.values())).to(device)
    return found
