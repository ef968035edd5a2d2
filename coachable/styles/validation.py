"""Checks of a style: shape, NaN, range and one-hots."""

from collections.abc import Sequence

import torch
from torch import Tensor

from coachable.styles.parameters import Choice, Parameter


class StyleRangeWarning(UserWarning):
    """A requested style lies outside the range that the agent was trained on."""


def violations(parameters: Sequence[Parameter], low: Tensor, high: Tensor, theta: Tensor) -> list[str]:
    """List range and one-hot violations of theta, one clause per parameter; the list is empty for a valid style.

    Args:
        parameters: Parameters in the order of theta's entries.
        low: Lower bounds `(dim,)`.
        high: Upper bounds `(dim,)`.
        theta: Styles `(..., dim)`.

    Returns:
        Clauses such as "step_length = 0.9 m lies outside [0.3, 0.65] m".

    Raises:
        ValueError: If the shape or type is wrong or a value is NaN, which cannot be clamped.
    """
    dim = len(low)
    if theta.ndim < 1 or theta.shape[-1] != dim or not theta.is_floating_point():
        raise ValueError(
            f"style has shape {tuple(theta.shape)} and type {theta.dtype}: "
            f"expected (..., {dim}) floating point, for {[p.name for p in parameters]}."
        )
    flat = theta.detach().to(torch.float32).reshape(-1, dim)
    blocks = list(zip(parameters, flat.split([p.width for p in parameters], -1), strict=True))
    if nan := [p.name for p, block in blocks if bool(block.isnan().any())]:
        raise ValueError(f"style is NaN in {nan}: expected numbers.")
    outside = ((flat < low.to(flat.device)) | (flat > high.to(flat.device))).any(0).tolist()
    clauses, first = [], 0
    for p, block in blocks:
        if isinstance(p, Choice):
            if not bool(_is_one_hot(block).all()):
                clauses.append(f"{p.name} is not a one-hot of its {p.width} options {list(p.options)}")
        elif outside[first]:
            clauses.append(f"{p.name} = {_span(block)}{_unit(p)} lies outside [{p.low:g}, {p.high:g}]{_unit(p)}")
        first += p.width
    return clauses


def _is_one_hot(block: Tensor) -> Tensor:
    """Return whether each row of `(N, n)` is a one-hot, `(N,)` bool."""
    return ((block == 0) | (block == 1)).all(-1) & (block.sum(-1) == 1)


def _span(values: Tensor) -> str:
    low, high = values.min().item(), values.max().item()
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _unit(parameter: Parameter) -> str:
    return f" {parameter.unit}" if parameter.unit else ""
