"""What can be wrong with a style: shape, NaN, range, one-hot."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from coachable.styles.parameters import Choice, Parameter

if TYPE_CHECKING:
    from coachable.styles.space import StyleSpace


class StyleRangeWarning(UserWarning):
    """A requested style lies outside the range that the agent was trained on."""


def violations(space: "StyleSpace", theta: Tensor) -> list[str]:
    """Range and one-hot violations of theta, one clause per parameter; empty if theta is a valid style.

    Args:
        space: What theta means.
        theta: `(..., dim)`.

    Returns:
        Clauses such as "step_length = 0.9 m lies outside [0.3, 0.65] m".

    Raises:
        ValueError: If the shape or type is wrong or a value is NaN, which no clamping repairs.
    """
    if theta.ndim < 1 or theta.shape[-1] != space.dim or not theta.is_floating_point():
        raise ValueError(
            f"style has shape {tuple(theta.shape)} and type {theta.dtype}: "
            f"expected (..., {space.dim}) floating point, for {list(space.names)}."
        )
    flat = theta.detach().to(torch.float32).reshape(-1, space.dim)
    nan = flat.isnan().any(0).tolist()
    if any(nan):
        raise ValueError(f"style is NaN in {[n for n, s in space.slices.items() if any(nan[s])]}: expected numbers.")
    outside = ((flat < space.low.to(flat.device)) | (flat > space.high.to(flat.device))).any(0).tolist()
    clauses = []
    for p in space.parameters:
        columns = space.slices[p.name]
        block = flat[:, columns]
        if isinstance(p, Choice):
            if not bool(_is_one_hot(block).all()):
                clauses.append(f"{p.name} is no one-hot of its {p.width} options {list(p.options)}")
        elif outside[columns.start]:
            clauses.append(f"{p.name} = {_span(block)}{_unit(p)} lies outside [{p.low:g}, {p.high:g}]{_unit(p)}")
    return clauses


def _is_one_hot(block: Tensor) -> Tensor:
    """`(N, n)` to `(N,)` boolean."""
    return ((block == 0) | (block == 1)).all(-1) & (block.sum(-1) == 1)


def _span(values: Tensor) -> str:
    low, high = values.min().item(), values.max().item()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _unit(parameter: Parameter) -> str:
    return f" {parameter.unit}" if parameter.unit else ""
