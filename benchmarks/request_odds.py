"""How rare requests for two styles at once are in training (paper: less than one in a million)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from coachable.styles import StyleSpace
from coachable.styles.samplers import Mixture, Uniform

__all__ = ["odds_rows", "probability_of_pair"]

_STRONG = 0.5  # of the largest weight: both styles are asked for at least this much
_WEAK = (0.05, 0.1, 0.2, 0.3)  # of the largest weight: all others at most this much, in either direction


def probability_of_pair(space: StyleSpace, pair: Sequence[str], weak: float, strong: float = _STRONG) -> float:
    """Compute the exact probability that training draws two styles together and hardly anything else.

    Only the component of the mixture in which every weight is drawn independently can draw two weights.

    Args:
        space: Style space whose sampler is a mixture with `Uniform` components.
        pair: Names of the two weights, which are to be at least `strong` of their largest value.
        weak: Largest magnitude of the other weights, as a share of their largest value.
        strong: Smallest value of the two weights, as a share of their largest value.

    Raises:
        ValueError: If the sampler is not a mixture of which the probability is known.
    """
    sampler = space.sampler
    if not isinstance(sampler, Mixture):
        raise ValueError(f"the sampler is a {type(sampler).__name__}: expected a Mixture")
    probability = 0.0
    for component, share in zip(sampler.components, sampler.weights, strict=True):
        if type(component) is not Uniform:  # one weight alone, or none
            continue
        for name, low, high in zip(space.names, component.low, component.high, strict=True):
            top = max(abs(low), abs(high))
            start, end = (strong * high, high) if name in pair else (max(low, -weak * top), min(high, weak * top))
            share *= max(0.0, end - start) / (high - low)
        probability += share
    return probability


def odds_rows(space: StyleSpace, pairs: Sequence[Sequence[str]], draws: int = 0, seed: int = 0) -> list[dict[str, Any]]:
    """Return how often training draws each pair, exactly, and as counted in `draws` draws if there are any.

    Args:
        space: Style space with the training's sampler.
        pairs: Names of two weights each.
        draws: Number of styles to draw.
        seed: Seed of the draws.
    """
    theta = space.sample((draws,), torch.Generator().manual_seed(seed)) / space.high if draws else None
    rows = []
    for pair in pairs:
        for weak in _WEAK:
            exact = probability_of_pair(space, pair, weak)
            row: dict[str, Any] = {"request": " + ".join(pair), "others_at_most": weak, "probability": exact}
            row["one_in"] = 1.0 / exact if exact else float("inf")
            if theta is not None:
                asked = torch.tensor([name in pair for name in space.names])
                fits = (theta[:, asked] >= _STRONG).all(-1) & (theta[:, ~asked].abs() <= weak).all(-1)
                row["counted"] = int(fits.sum())
            rows.append(row)
    return rows
