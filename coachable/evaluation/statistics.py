"""Aggregates with intervals: interquartile mean, bootstrap, rank correlation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of the values (Agarwal et al. 2021, arXiv 2108.13264).

    Args:
        values: numbers; a quarter of them, rounded down, is cut at each end of `axis`.
        axis: axis to aggregate.
    """
    ordered = np.sort(values, axis=axis)
    count = ordered.shape[axis]
    cut = count // 4
    return np.take(ordered, np.arange(cut, count - cut), axis=axis).mean(axis=axis)


def bootstrap_interval(
    values: np.ndarray,
    statistic: Callable[..., np.ndarray] = np.mean,
    *,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic of independent values.

    Args:
        values: (n,) numbers; NaN are left out.
        statistic: called as `statistic(samples, axis=-1)`.
        confidence: probability content of the interval.
        resamples: number of bootstrap samples.
        seed: of the resampling.

    Returns:
        Lower and upper bound; NaN where there are no values.
    """
    values = values[~np.isnan(values)]
    if len(values) == 0:
        return float("nan"), float("nan")
    draws = np.random.default_rng(seed).integers(0, len(values), (resamples, len(values)))
    spread = statistic(values[draws], axis=-1)
    tail = 50 * (1 - confidence)
    low, high = np.percentile(spread, [tail, 100 - tail])
    return float(low), float(high)


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's rank correlation of two (n,) arrays; ties share their mean rank. NaN pairs are left out."""
    keep = ~(np.isnan(x) | np.isnan(y))
    ranks = [_ranks(values[keep]) for values in (x, y)]
    if len(ranks[0]) < 2 or min(np.ptp(r) for r in ranks) == 0:
        return float("nan")
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts - 1) / 2)[inverse]
