import numpy as np
import pytest

from coachable.evaluation.statistics import (
    bootstrap_interval,
    comparison_interval,
    interquartile_mean,
    rank_correlation,
    stratified_interval,
)


def test_interquartile_mean_drops_a_quarter_at_each_end():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    np.testing.assert_allclose(interquartile_mean(np.arange(16.0).reshape(2, 8)), [3.5, 11.5])


def test_bootstrap_interval_of_a_mean_matches_the_normal_one():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    low, high = bootstrap_interval(values)
    error = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - error, abs=0.15 * error)
    assert high == pytest.approx(values.mean() + error, abs=0.15 * error)


def test_bootstrap_interval_leaves_nan_out():
    assert bootstrap_interval(np.array([1.0, np.nan, 1.0])) == (1.0, 1.0)
    assert np.isnan(bootstrap_interval(np.array([np.nan]))).all()


def test_one_value_has_no_interval():
    one, two = np.array([1.0, np.nan]), np.array([1.0, 2.0])
    assert np.isnan(bootstrap_interval(one)).all() and np.isnan(stratified_interval(one[None])).all()
    assert np.isnan(comparison_interval(one, two, np.subtract)).all()
    assert np.isnan(comparison_interval(two, one, np.subtract)).all()


def test_rank_correlation():
    x = np.array([1.0, 2.0, 3.0, 4.0])
    assert rank_correlation(x, np.exp(x)) == pytest.approx(1.0)
    assert rank_correlation(x, -(x**3)) == pytest.approx(-1.0)
    # Ranks 1, 2.5, 2.5, 4 against 1..4: covariance 4.5, variances 4.5 and 5.
    assert rank_correlation(x, np.array([0.0, 5.0, 5.0, 9.0])) == pytest.approx(4.5 / np.sqrt(4.5 * 5))
    assert np.isnan(rank_correlation(x, np.ones(4)))
    assert rank_correlation(np.array([1.0, 2.0, np.nan]), np.array([3.0, 4.0, 0.0])) == pytest.approx(1.0)


def test_interquartile_mean_leaves_nan_out():
    assert interquartile_mean(np.array([np.nan, 100.0, 1.0, 2.0, -50.0])) == 1.5
    np.testing.assert_array_equal(interquartile_mean(np.array([[np.nan, np.nan], [3.0, np.nan]])), [np.nan, 3.0])


def test_stratified_interval_keeps_every_task():
    """Runs agree on each task: however they are drawn, the mean of the tasks stays, where a plain bootstrap varies."""
    agreed = np.tile([0.0, 1.0, 5.0, 6.0], (5, 1))
    assert stratified_interval(agreed) == (3.0, 3.0)
    low, high = stratified_interval(np.random.default_rng(0).normal(1.0, 0.5, (50, 8)))
    assert low < 1.0 < high and high - low < 0.2
    assert np.isnan(stratified_interval(np.full((2, 2), np.nan))).all()
