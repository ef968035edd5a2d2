"""Soft indicator of an interval, for the rewards of set-points."""

import math
from functools import lru_cache

import torch
from torch import Tensor

_MAY_BE_ZERO = frozenset({"cosine", "linear", "quadratic"})
_SIGMOIDS = ("gaussian", "hyperbolic", "long_tail", "reciprocal", "cosine", "linear", "quadratic", "tanh_squared")


def tolerance(
    x: Tensor,
    lower: float | Tensor = 0.0,
    upper: float | Tensor = 0.0,
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> Tensor:
    """Return 1 where `lower <= x <= upper`, and values that fall with the distance from the interval elsewhere.

    The result equals that of `dm_control.utils.rewards.tolerance`. This function is differentiable and runs on any
    device, and its bounds may be tensors, so that a style can set them.

    Args:
        x: Values `(...)`, floating point.
        lower: Lower bound, a number or a tensor that broadcasts with `x`; may be infinite.
        upper: Upper bound, in the same form. Tensors are not checked for `lower <= upper`.
        margin: Distance at which the value is `value_at_margin`, in the unit of `x`; 0 gives a hard indicator.
        sigmoid: Shape of the decline: "gaussian", "hyperbolic", "long_tail", "reciprocal", "cosine", "linear",
            "quadratic" or "tanh_squared".
        value_at_margin: In (0, 1); 0 is allowed for "cosine", "linear" and "quadratic". Unused if `margin` is 0.

    Returns:
        Values in [0, 1], in the broadcast shape of `x` and the bounds.

    Raises:
        ValueError: If `lower > upper`, `margin < 0`, or `sigmoid` or `value_at_margin` is not valid.

    Examples:
        >>> tolerance(torch.tensor([0.5, 0.65, 0.70]), 0.5, 0.6, margin=0.05, sigmoid="linear")
        tensor([1.0000, 0.1000, 0.0000])
    """
    if not isinstance(lower, Tensor) and not isinstance(upper, Tensor) and lower > upper:
        raise ValueError(f"tolerance has lower = {lower} > upper = {upper}: expected lower <= upper.")
    if margin < 0:
        raise ValueError(f"tolerance has margin = {margin}: expected a number >= 0.")
    if margin == 0:
        return ((x >= lower) & (x <= upper)).to(x.dtype)
    scale = _scale(sigmoid, value_at_margin)
    return _decline(_distance(x, lower, upper) * (scale / margin), sigmoid)


def _distance(x: Tensor, lower: float | Tensor, upper: float | Tensor) -> Tensor:
    """Return the distance from the interval, without a mask, so that gradients stay finite.

    The special cases give the same values in fewer operations.
    """
    if lower is upper:
        return (x - upper).abs()
    if isinstance(upper, float) and upper == math.inf:
        return (lower - x).relu()
    if isinstance(lower, float) and lower == -math.inf:
        return (x - upper).relu()
    return torch.maximum(lower - x, x - upper).relu()


@lru_cache(maxsize=256)
def _scale(sigmoid: str, value: float) -> float:
    """Return the factor on the distance that makes the sigmoid equal `value` at distance 1."""
    if sigmoid not in _SIGMOIDS:
        raise ValueError(f"unknown sigmoid {sigmoid!r}: expected one of {_SIGMOIDS}.")
    if not (0 < value < 1 or (value == 0 and sigmoid in _MAY_BE_ZERO)):
        raise ValueError(
            f"value_at_margin is {value} for sigmoid {sigmoid!r}: expected a number in (0, 1), "
            f"or 0 for {sorted(_MAY_BE_ZERO)}."
        )
    match sigmoid:
        case "gaussian":
            return math.sqrt(-2 * math.log(value))
        case "hyperbolic":
            return math.acosh(1 / value)
        case "long_tail":
            return math.sqrt(1 / value - 1)
        case "reciprocal":
            return 1 / value - 1
        case "cosine":
            return math.acos(2 * value - 1) / math.pi
        case "linear":
            return 1 - value
        case "quadratic":
            return math.sqrt(1 - value)
        case _:
            return math.atanh(math.sqrt(1 - value))


def _decline(z: Tensor, sigmoid: str) -> Tensor:
    """Return the sigmoid at scaled distance `z >= 0`."""
    match sigmoid:
        case "gaussian":
            return torch.exp(z.square().mul(-0.5))
        case "hyperbolic":
            # 1 / cosh(z) by exp, because cosh overflows and gives other bits for other memory layouts.
            decay = torch.exp(-z)
            return 2 * decay / (1 + decay.square())
        case "long_tail":
            return z.square().add(1).reciprocal()
        case "reciprocal":
            return z.add(1).reciprocal()
        case "cosine":
            return (1 + torch.cos(math.pi * z.clamp(max=1))) / 2
        case "linear":
            return (1 - z).clamp(min=0)
        case "quadratic":
            return (1 - z.square()).clamp(min=0)
        case _:
            return 1 - torch.tanh(z).square()
