"""Statistics: interquartile mean, bootstrap and Wilson intervals, rank correlation."""

from collections.abc import Callable
from typing import cast

import numpy as np
from scipy import stats

_RESAMPLES = 2000  # bootstrap samples


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Compute the mean of the middle half of the values (Agarwal et al. 2021, arXiv 2108.13264).

    Args:
        values: Numbers (..., n); NaN are left out. A quarter of the others, rounded down, is cut at each end.

    Returns:
        The means (...); NaN where there are no values.
    """
    ordered = np.sort(values)  # NaN come last
    count = (~np.isnan(ordered)).sum(-1, keepdims=True)
    cut = count // 4
    position = np.arange(ordered.shape[-1])
    middle = (position >= cut) & (position < count - cut)
    total = np.where(middle, ordered, 0.0).sum(-1)
    kept = middle.sum(-1)
    return np.divide(total, kept, out=np.full(total.shape, np.nan), where=kept > 0)


def stratified_interval(scores: np.ndarray) -> tuple[float, float]:
    """Compute the 95 % percentile bootstrap interval of the interquartile mean of several runs on several tasks.

    Runs are drawn with replacement for each task separately, so every resample has every task (Agarwal et al. 2021,
    arXiv 2108.13264).

    Args:
        scores: Scores (runs, tasks); NaN are left out.

    Returns:
        Lower and upper bound; NaN if there are no values, or those of one run only.
    """
    if np.isnan(scores).all() or len(scores) < 2:
        return float("nan"), float("nan")
    runs, tasks = scores.shape
    draws = np.random.default_rng(0).integers(0, runs, (_RESAMPLES, runs, tasks))
    spread = interquartile_mean(scores[draws, np.arange(tasks)].reshape(_RESAMPLES, -1))
    low, high = np.nanpercentile(spread, [2.5, 97.5])
    return float(low), float(high)


def bootstrap_interval(
    values: np.ndarray, statistic: Callable[..., np.ndarray] = np.mean, *, resamples: int = _RESAMPLES
) -> tuple[float, float]:
    """Compute the 95 % percentile bootstrap interval of a statistic of independent values.

    Args:
        values: Numbers (n,); NaN are left out.
        statistic: Function that is called as `statistic(samples, axis=-1)`.
        resamples: Number of bootstrap samples.

    Returns:
        Lower and upper bound; NaN if there are fewer than two values, which tell nothing about their spread.
    """
    values = values[~np.isnan(values)]
    if len(values) < 2:
        return float("nan"), float("nan")
    options = {"n_resamples": resamples, "confidence_level": 0.95, "method": "percentile", "vectorized": True}
    low, high = stats.bootstrap((values,), statistic, rng=np.random.default_rng(0), **options).confidence_interval
    return float(low), float(high)


def comparison_interval(
    values: np.ndarray, others: np.ndarray, compare: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[float, float]:
    """Compute the 95 % percentile bootstrap interval of a comparison of two means, such as their ratio.

    Args:
        values: Numbers (n,); NaN are left out.
        others: Numbers (m,) that they are compared with, independent of them; NaN are left out.
        compare: Function of both means, elementwise.

    Returns:
        Lower and upper bound; NaN if one of the two has fewer than two values.
    """
    kept = [numbers[~np.isnan(numbers)] for numbers in (values, others)]
    if min(map(len, kept)) < 2:
        return float("nan"), float("nan")
    generator = np.random.default_rng(0)
    means = (numbers[generator.integers(0, len(numbers), (_RESAMPLES, len(numbers)))].mean(1) for numbers in kept)
    low, high = np.percentile(compare(*means), [2.5, 97.5])
    return float(low), float(high)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Compute Wilson's 95 % interval of a probability from the number of successes and trials.

    Raises:
        ValueError: If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"{successes} successes in {trials} trials: expected 0 to trials, and at least one trial")
    low, high = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(low), float(high)


def rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Compute Spearman's rank correlation of two arrays (n,); ties share their mean rank, NaN pairs are left out."""
    keep = ~(np.isnan(x) | np.isnan(y))
    if keep.sum() < 2 or min(np.ptp(values[keep]) for values in (x, y)) == 0:
        return float("nan")
    correlation, _ = stats.spearmanr(x[keep], y[keep])
    return float(cast(float, correlation))
