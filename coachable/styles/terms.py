"""Terms of the style reward: small callables that say which style parameters they read.

A term maps `(features, style)` to a reward `(...,)`. `features` is what the environment emitted (one tensor `(..., F)`,
or a nested tensordict), `style` a mapping from parameter name to its block of theta.

Only elementwise operations appear here, in a fixed order. A reduction such as `Tensor.sum` may add in another order for
another batch shape or memory layout, and the relabelled reward would differ in its last bits from the collected one.
So do a few elementwise functions of PyTorch 2.13 on the CPU (measured): `sigmoid`, `cosh`, `atan2` and `pow` with a
fractional exponent; `exp`, `log`, `tanh`, `sqrt`, `sin` and `cos` do not.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor, nn

from coachable.styles.tolerance import tolerance
from coachable.styles.view import StyleView

if TYPE_CHECKING:  # tensordicts are welcome, but this package runs on torch alone
    from tensordict import TensorDictBase

Features: TypeAlias = "Tensor | TensorDictBase"
Style: TypeAlias = Mapping[str, Tensor]
FeatureKey: TypeAlias = int | slice | str | tuple[Any, ...]


@runtime_checkable
class StyleTerm(Protocol):
    """Anything callable as `(features, style) -> (...,)` that names the parameters it reads."""

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the style parameters that it reads."""
        ...

    def __call__(self, features: Features, style: Style) -> Tensor:
        """Return the reward of the term, `(...,)`, before its scale."""
        ...


@dataclass(frozen=True)
class Term:
    """Wraps a plain function as a term.

    Args:
        function: `(features, style) -> (...,)`.
        parameters: Names of the style parameters that the function reads.

    Examples:
        >>> term = Term(lambda features, style: style["fuel"] * features[..., 0], parameters=("fuel",))
        >>> term(torch.tensor([[2.0]]), {"fuel": torch.tensor([3.0])})
        tensor([6.])
    """

    function: Callable[[Any, Style], Tensor]
    parameters: tuple[str, ...]

    def __post_init__(self) -> None:
        parameters = (self.parameters,) if isinstance(self.parameters, str) else tuple(self.parameters)
        object.__setattr__(self, "parameters", parameters)

    def __call__(self, features: Features, style: Style) -> Tensor:
        """Call the function."""
        return self.function(features, style)


def feature(features: Features, key: FeatureKey) -> Tensor:
    """Pick one feature.

    Args:
        features: Tensor `(..., F)` or tensordict.
        key: For a tensor an index, `(...,)`, or a slice, `(..., k)`. For a tensordict a key, nested if a tuple, whose
            last part may be an index or slice into the entry: `"speed"`, `("gait", "length")`, `("arms", 0)`.

    Returns:
        The entry as it is stored: an entry `(..., 1)` of a tensordict keeps its last dimension.

    Raises:
        KeyError: If the features are one tensor but the key a name, or the tensordict lacks the key.
    """
    if isinstance(key, int | slice):
        return features[..., key]
    name, column = key, None
    if isinstance(key, tuple) and isinstance(key[-1], int | slice):
        name, column = key[:-1], key[-1]
    entry = None if isinstance(features, Tensor) else features.get(name, None)
    if entry is None:
        raise KeyError(_no_such_feature(features, name))
    return entry if column is None else entry[..., column]


def _no_such_feature(features: Features, name: Any) -> str:
    if isinstance(features, Tensor):
        return (
            f"no style feature named {name}: the environment emits one tensor of {features.shape[-1]} columns, "
            "to be read by index or slice."
        )
    paths = (key if isinstance(key, str) else ".".join(key) for key in features.keys(True, True))
    return f"no style feature named {name}: the environment emits {', '.join(sorted(paths))}."


def scalar_feature(features: Features, key: FeatureKey, like: Tensor) -> Tensor:
    """Return a feature as `(...,)`, without the trailing 1 of an entry that has one dimension more than `like`."""
    value = feature(features, key)
    return value.squeeze(-1) if value.ndim == like.ndim + 1 and value.shape[-1] == 1 else value


def weighted_sum(weights: Tensor, values: Tensor) -> Tensor:
    """Sum products over the last dimension, with the same bits for every batch shape, memory layout and device.

    Args:
        weights: `(..., k)`.
        values: `(..., k)`, broadcastable.

    Returns:
        `(...,)`.
    """
    # Elementwise additions, first to last: unlike a reduction kernel, they cannot depend on strides or batch shape.
    return reduce(operator.add, (weights * values).unbind(-1))


@dataclass(frozen=True)
class WeightedFeature:
    """`w * g`: one weight times one feature.

    Args:
        parameter: Name of the `Weight`.
        key: Feature to scale, see `feature`.
    """

    parameter: str
    key: FeatureKey

    @property
    def parameters(self) -> tuple[str, ...]:
        """The weight."""
        return (self.parameter,)

    def __call__(self, features: Features, style: Style) -> Tensor:
        """`(...,)`."""
        weight = style[self.parameter]
        return weight * scalar_feature(features, self.key, weight)


class WeightedSum:
    """`sum_i w_i g_i` over many weights at once, `features[..., i]` belonging to `parameters[i]` (paper, combat).

    One term instead of one `WeightedFeature` per parameter, which matters at 18 of them in every environment step.

    Args:
        parameters: Names of the weights, in the order of the features.
        key: Features `(..., len(parameters))`, see `feature`; by default all of them.
    """

    def __init__(self, parameters: Sequence[str], key: FeatureKey | None = None) -> None:
        self.parameters = tuple(parameters)
        self.key = key

    def __call__(self, features: Features, style: Style) -> Tensor:
        """`(...,)`."""
        if isinstance(style, StyleView):
            weights = style.block(self.parameters)
        else:
            weights = torch.stack([style[name] for name in self.parameters], dim=-1)
        values = features if self.key is None else feature(features, self.key)
        if values.shape[-1] != len(self.parameters):
            raise ValueError(
                f"WeightedSum reads {values.shape[-1]} features for {len(self.parameters)} weights {self.parameters}: "
                "expected as many, in the same order. Pass `key` to select them."
            )
        return weighted_sum(weights, values)


@dataclass(frozen=True)
class SetpointTolerance:
    """`tolerance` of a feature around a set-point: 1 within `half_width` of the requested value.

    Args:
        parameter: Name of the `Setpoint`.
        key: Measured feature, in the unit of the set-point; see `feature`.
        margin: Distance at which the reward is `value_at_margin`, same unit.
        sigmoid: Shape of the decline, see `tolerance`.
        value_at_margin: See `tolerance`.
        half_width: Half width of the interval that counts as exact, same unit.
        gate: Optional feature that multiplies the term, such as a "step completed" flag.
    """

    parameter: str
    key: FeatureKey
    margin: float
    sigmoid: str = "long_tail"
    value_at_margin: float = 0.1
    half_width: float = 0.0
    gate: FeatureKey | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """The set-point."""
        return (self.parameter,)

    def __call__(self, features: Features, style: Style) -> Tensor:
        """`(...,)`."""
        target = style[self.parameter]
        measured = scalar_feature(features, self.key, target)
        half = self.half_width
        lower, upper = (target - half, target + half) if half else (target, target)
        value = tolerance(measured, lower, upper, self.margin, self.sigmoid, self.value_at_margin)
        return value if self.gate is None else value * scalar_feature(features, self.gate, target).to(value.dtype)


class ChoiceTolerance:
    """Mean `tolerance` of several features inside bounds that depend on the chosen option (paper, arm poses).

    Args:
        parameter: Name of the `Choice`.
        key: Features `(..., k)`, see `feature`.
        lower: `(n_options, k)` lower bounds, in the unit of the features.
        upper: `(n_options, k)` upper bounds.
        margin: Distance at which the value is `value_at_margin`, same unit.
        sigmoid: Shape of the decline, see `tolerance`.
        value_at_margin: See `tolerance`.

    Raises:
        ValueError: If the bounds are no two matrices of one shape, or a lower bound exceeds its upper bound.
    """

    def __init__(
        self,
        parameter: str,
        key: FeatureKey,
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
        self.parameters = (parameter,)
        self.key, self.margin, self.sigmoid, self.value_at_margin = key, margin, sigmoid, value_at_margin
        # Both bounds in one table, (n_options, 2k): one look-up per step instead of two.
        self._bounds = {lower.device: torch.cat([lower, upper], dim=-1)}
        self._mean = {lower.device: torch.full((lower.shape[1],), 1.0 / lower.shape[1], device=lower.device)}

    def __call__(self, features: Features, style: Style) -> Tensor:
        """`(...,)`."""
        option = style[self.parameters[0]].argmax(-1)
        table, mean = _on(self._bounds, option.device), _on(self._mean, option.device)
        lower, upper = nn.functional.embedding(option, table).chunk(2, dim=-1)  # (..., k) each
        value = tolerance(feature(features, self.key), lower, upper, self.margin, self.sigmoid, self.value_at_margin)
        return weighted_sum(mean, value)


def _on(copies: dict[torch.device, Tensor], device: torch.device) -> Tensor:
    """Return the copy of a constant on a device, made on first use."""
    found = copies.get(device)
    if found is None:
        found = copies[device] = next(iter(copies.values())).to(device)
    return found
