"""Gait bookkeeping on scripted feet: index 0 is the right foot, 1 the left one."""

import numpy as np
import pytest

from coachable.envs.humanoid.gait import GaitTracker
from coachable.envs.humanoid.model import CONTROL_STEP

UP, DOWN = 0.05, -0.001


def make_tracker(expected=0, step_max=1.0):
    tracker = GaitTracker.create(1, step_max)
    side_by_side = np.array([[[0.0, -0.1], [0.0, 0.1]]])
    tracker.reset(np.array([0]), np.array([expected]), side_by_side, np.zeros((1, 2)))
    return tracker


def advance(tracker, right_x, left_x, right_height, left_height, knees=(0.0, 0.0)):
    feet = np.array([[[right_x, -0.1], [left_x, 0.1]]])
    return tracker.update(feet, np.array([[right_height, left_height]]), np.array([knees]))


def test_a_strike_needs_the_expected_foot_to_leave_the_floor_and_return():
    tracker = make_tracker(expected=0)
    assert not advance(tracker, 0.0, 0.0, DOWN, DOWN).completed[0]  # never lifted
    assert not advance(tracker, 0.2, 0.0, UP, DOWN).completed[0]
    report = advance(tracker, 0.4, 0.0, DOWN, DOWN)
    assert report.completed[0]
    assert report.length[0] == pytest.approx(0.4)
    assert report.duration[0] == pytest.approx(3 * CONTROL_STEP)
    assert tracker.expected[0] == 1
    assert tracker.clock[0] == 0


def test_the_other_foot_does_not_strike():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.0, 0.3, DOWN, UP)
    assert not advance(tracker, 0.0, 0.4, DOWN, DOWN).completed[0]
    assert tracker.expected[0] == 0


def test_stride_fraction_is_the_share_of_the_step_in_its_stride():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN)
    first = advance(tracker, 0.3, 0.0, DOWN, DOWN)
    assert first.stride_fraction[0] == 0.5  # no stride yet
    advance(tracker, 0.3, 0.2, DOWN, UP)
    second = advance(tracker, 0.3, 0.9, DOWN, DOWN)
    assert second.length[0] == pytest.approx(0.6)
    assert second.stride_fraction[0] == pytest.approx(0.6 / (0.6 + 0.3))
    np.testing.assert_allclose(tracker.step_vector[0], [-0.6, -0.2])  # right relative to left: right must strike next
    np.testing.assert_allclose(tracker.stride_vector[0], [-0.3, 0.2])


def test_a_step_backwards_has_no_share_in_a_stride():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN)
    advance(tracker, 0.3, 0.0, DOWN, DOWN)
    advance(tracker, 0.3, 0.1, DOWN, UP)
    report = advance(tracker, 0.3, 0.1, DOWN, DOWN)
    assert report.completed[0]
    assert report.length[0] == pytest.approx(-0.2)
    assert report.stride_fraction[0] == 0.0


def test_knee_range_covers_the_step_and_starts_anew():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN, knees=(-1.2, 0.02))
    report = advance(tracker, 0.3, 0.0, DOWN, DOWN, knees=(-0.1, -0.3))
    assert report.knee_min[0] == pytest.approx(-1.2)
    assert report.knee_max[0] == pytest.approx(0.02)
    np.testing.assert_allclose(tracker.knee_min[0], [-0.1, -0.3])
    np.testing.assert_allclose(tracker.knee_max[0], [-0.1, -0.3])


def test_time_out_is_flagged_in_every_step_beyond_step_max():
    tracker = make_tracker(step_max=3 * CONTROL_STEP)
    flags = [bool(advance(tracker, 0.0, 0.0, DOWN, DOWN).timed_out[0]) for _ in range(5)]
    assert flags == [False, False, False, True, True]
    assert tracker.observe()[0, -1] == pytest.approx(5 / 3)
    for _ in range(5):
        advance(tracker, 0.0, 0.0, DOWN, DOWN)
    assert tracker.observe()[0, -1] == 2.0  # clipped


@pytest.mark.parametrize("expected", [0, 1])
def test_an_episode_starts_with_the_foot_to_strike_relative_to_the_other(expected):
    tracker = GaitTracker.create(2, 1.0)
    feet = np.array([[[0.3, -0.1], [-0.2, 0.15]], [[1.0, -0.3], [0.5, 0.1]]])
    tracker.reset(np.array([0, 1]), np.full(2, expected), feet, np.zeros((2, 2)))
    right_from_left = np.array([[0.5, -0.25], [0.5, -0.4]])
    wanted = right_from_left if expected == 0 else -right_from_left
    np.testing.assert_allclose(tracker.observe()[:, 6:8], wanted)
    np.testing.assert_allclose(tracker.observe()[:, 8:10], wanted)


def test_reset_touches_only_the_given_rows():
    tracker = GaitTracker.create(3, 1.0)
    feet = np.zeros((3, 2, 2))
    tracker.reset(np.arange(3), np.zeros(3, dtype=int), feet, np.zeros((3, 2)))
    tracker.update(feet, np.full((3, 2), UP), np.ones((3, 2)))
    before = {name: values.copy() for name, values in tracker.arrays().items()}
    tracker.reset(np.array([1]), np.array([1]), feet[:1], np.zeros((1, 2)))
    for name, values in tracker.arrays().items():
        np.testing.assert_array_equal(values[[0, 2]], before[name][[0, 2]])
    assert tracker.expected[1] == 1
    assert tracker.clock[1] == 0
