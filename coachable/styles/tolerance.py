"""Soft indicator of an interval, for the rewards of set-points."""

import math

import torch
from torch import Tensor

_SIGMOIDS = ("linear", "long_tail")


def tolerance(
    x: Tensor,
    lower: float | Tensor = 0.0,
    upper: float | Tensor = 0.0,
    margin: float = 0.0,
    sigmoid: str = "long_tail",
    value_at_margin: float = 0.1,
) -> Tensor:
    """Return 1 where `lower <= x <= upper`, and values that fall with the distance from the interval elsewhere.

    The result equals that of `dm_control.utils.rewards.tolerance` with the same sigmoid. This function is
    differentiable and runs on any device, and its bounds may be tensors, so that a style can set them.

    Args:
        x: Values `(...)`, floating point.
        lower: Lower bound, a number or a tensor that broadcasts with `x`; may be infinite.
        upper: Upper bound, in the same form. Tensors are not checked for `lower <= upper`.
        margin: Distance at which the value is `value_at_margin`, in the unit of `x`; 0 gives a hard indicator.
        sigmoid: Shape of the decline: "linear", which reaches 0, or "long_tail", 1 / (1 + z^2) of a scaled distance z.
        value_at_margin: In (0, 1); 0 is allowed for "linear". Unused if `margin` is 0.

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
    if not 0 <= margin < math.inf:
        raise ValueError(f"tolerance has margin = {margin}: expected a finite number >= 0.")
    if margin == 0:
        return ((x >= lower) & (x <= upper)).to(x.dtype)
    if sigmoid not in _SIGMOIDS:
        raise ValueError(f"unknown sigmoid {sigmoid!r}: expected one of {', '.join(_SIGMOIDS)}.")
    if not (0 < value_at_margin < 1 or (value_at_margin == 0 and sigmoid == "linear")):
        raise ValueError(
            f"value_at_margin is {value_at_margin} for sigmoid {sigmoid!r}: expected a number in (0, 1), "
            "or 0 for linear."
        )
    distance = _distance(x, lower, upper)
    if sigmoid == "linear":
        return (1 - distance * ((1 - value_at_margin) / margin)).clamp(min=0)
    return (distance * (math.sqrt(1 / value_at_margin - 1) / margin)).square().add(1).reciprocal()


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
