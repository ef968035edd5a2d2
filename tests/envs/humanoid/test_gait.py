"""Gait bookkeeping on scripted feet: index 0 is the right foot, 1 the left one."""

import numpy as np
import pytest

from coachable.envs.humanoid.gait import GaitTracker
from coachable.envs.humanoid.model import CONTROL_STEP
from coachable.envs.humanoid.simulation import HumanoidSimulation, Kinematics

UP, DOWN = 0.05, -0.001
NO_FORCE, AHEAD = np.zeros((1, 2)), np.zeros(1)


def geometry(feet, clearance, pitch=(0.0, 0.0)):
    """Kinematics of one walker of which only the feet matter."""
    blank = np.zeros(1)
    feet = np.array([feet], dtype=float)
    positions = np.concatenate([feet, np.zeros((1, 2, 1))], axis=-1)
    return Kinematics(
        torso_axes=blank,
        torso_position=blank,
        head_height=blank,
        extremities=blank,
        feet=positions,
        foot_clearance=np.array([clearance]),
        foot_pitch=np.array([pitch]),
        soles=feet,
        com_velocity=blank,
        pelvis_quaternion=blank,
    )


def make_tracker(expected=0, step_max=1.0):
    tracker = GaitTracker.create(1, step_max)
    side_by_side = np.array([[[0.0, -0.1], [0.0, 0.1]]])
    tracker.reset(np.array([0]), np.array([expected]), side_by_side, np.zeros((1, 2)), side_by_side)
    return tracker


def advance(tracker, right_x, left_x, right_height, left_height, knees=(0.0, 0.0), times=1, forces=NO_FORCE, **more):
    """Let `times` control steps pass with the feet where they are said to be; return what the last one reports."""
    kinematics = geometry([[right_x, -0.1], [left_x, 0.1]], [right_height, left_height], **more)
    for _ in range(times):
        report = tracker.update(kinematics, np.array([knees]), forces, AHEAD)
    return report


def test_a_strike_needs_the_expected_foot_to_leave_the_floor_and_return():
    tracker = make_tracker(expected=0)
    assert not advance(tracker, 0.0, 0.0, DOWN, DOWN).completed[0]  # never lifted
    assert not advance(tracker, 0.2, 0.0, UP, DOWN, times=2).completed[0]
    report = advance(tracker, 0.4, 0.0, DOWN, DOWN)
    assert report.completed[0]
    assert report.length[0] == pytest.approx(0.4)
    assert report.duration[0] == pytest.approx(4 * CONTROL_STEP)
    assert tracker.expected[0] == 1
    assert tracker.clock[0] == 0


def test_the_other_foot_does_not_strike():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.0, 0.3, DOWN, UP, times=2)
    assert not advance(tracker, 0.0, 0.4, DOWN, DOWN).completed[0]
    assert tracker.expected[0] == 0


def test_stride_fraction_is_the_share_of_the_step_in_its_stride():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN, times=2)
    first = advance(tracker, 0.3, 0.0, DOWN, DOWN)
    assert first.stride_fraction[0] == 0.5  # no stride yet
    advance(tracker, 0.3, 0.2, DOWN, UP, times=2)
    second = advance(tracker, 0.3, 0.9, DOWN, DOWN)
    assert second.length[0] == pytest.approx(0.6)
    assert second.stride_fraction[0] == pytest.approx(0.6 / (0.6 + 0.3))
    np.testing.assert_allclose(tracker.step_vector[0], [-0.6, -0.2])  # right relative to left: right must strike next
    np.testing.assert_allclose(tracker.stride_vector[0], [-0.3, 0.2])


def test_a_step_backwards_has_no_share_in_a_stride():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN, times=2)
    advance(tracker, 0.3, 0.0, DOWN, DOWN)
    advance(tracker, 0.3, 0.1, DOWN, UP, times=2)
    report = advance(tracker, 0.3, 0.1, DOWN, DOWN)
    assert report.completed[0]
    assert report.length[0] == pytest.approx(-0.2)
    assert report.stride_fraction[0] == 0.0


def test_knee_range_covers_the_step_and_starts_anew():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN, knees=(-1.2, 0.02), times=2)
    report = advance(tracker, 0.3, 0.0, DOWN, DOWN, knees=(-0.1, -0.3))
    assert report.knee_min[0] == pytest.approx(-1.2)
    assert report.knee_max[0] == pytest.approx(0.02)
    np.testing.assert_allclose(tracker.knee_min[0], [-0.1, -0.3])
    np.testing.assert_allclose(tracker.knee_max[0], [-0.1, -0.3])


def test_time_out_is_flagged_in_every_step_beyond_step_max():
    tracker = make_tracker(step_max=3 * CONTROL_STEP)
    flags = [bool(advance(tracker, 0.0, 0.0, DOWN, DOWN).timed_out[0]) for _ in range(5)]
    assert flags == [False, False, False, True, True]
    assert tracker.observe(AHEAD)[0, -1] == pytest.approx(5 / 3)
    for _ in range(5):
        advance(tracker, 0.0, 0.0, DOWN, DOWN)
    assert tracker.observe(AHEAD)[0, -1] == 2.0  # clipped


@pytest.mark.parametrize("expected", [0, 1])
def test_an_episode_starts_with_the_foot_to_strike_relative_to_the_other(expected):
    tracker = GaitTracker.create(2, 1.0)
    feet = np.array([[[0.3, -0.1], [-0.2, 0.15]], [[1.0, -0.3], [0.5, 0.1]]])
    tracker.reset(np.array([0, 1]), np.full(2, expected), feet, np.zeros((2, 2)), feet)
    right_from_left = np.array([[0.5, -0.25], [0.5, -0.4]])
    wanted = right_from_left if expected == 0 else -right_from_left
    np.testing.assert_allclose(tracker.observe(np.zeros(2))[:, 6:8], wanted)
    np.testing.assert_allclose(tracker.observe(np.zeros(2))[:, 8:10], wanted)


def test_reset_touches_only_the_given_rows():
    tracker = GaitTracker.create(3, 1.0)
    feet = np.zeros((3, 2, 2))
    tracker.reset(np.arange(3), np.zeros(3, dtype=int), feet, np.zeros((3, 2)), feet)
    simulation = HumanoidSimulation(3)
    simulation.state[:, 3] += 0.5
    tracker.update(simulation.kinematics(), np.ones((3, 2)), np.ones((3, 2)), np.zeros(3))
    before = {name: values.copy() for name, values in tracker.arrays().items()}
    tracker.reset(np.array([1]), np.array([1]), feet[:1], np.zeros((1, 2)), feet[:1])
    for name, values in tracker.arrays().items():
        np.testing.assert_array_equal(values[[0, 2]], before[name][[0, 2]])
    assert tracker.expected[1] == 1
    assert tracker.clock[1] == 0
    assert (tracker.airborne[1] == 0).all() and (tracker.prints[1] == 0).all() and (tracker.highest[1] == 0).all()
    assert tracker.force[1] == 0


def test_a_bounce_leaves_no_new_footprint():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN)
    assert not advance(tracker, 0.1, 0.0, DOWN, DOWN).completed[0]  # off the floor for one control step only
    advance(tracker, 0.1, 0.0, UP, DOWN, times=2)
    assert advance(tracker, 0.2, 0.0, DOWN, DOWN).length[0] == pytest.approx(0.2)


def test_a_step_is_measured_between_footprints_not_between_feet():
    """The standing foot slips by 5 cm: the ruler goes from where it came down."""
    tracker = make_tracker(expected=0)
    advance(tracker, 0.3, 0.05, UP, DOWN, times=2)
    report = advance(tracker, 0.4, 0.05, DOWN, DOWN)
    assert report.length[0] == pytest.approx(0.4)


def test_lengths_and_drift_add_up_to_the_ground_covered():
    tracker = make_tracker(expected=0)
    random = np.random.default_rng(0)
    marks, lengths, drifts = [[0.0, -0.1], [0.0, 0.1]], [], []
    for step in range(8):
        foot = step % 2
        position = np.array(marks[-2:])
        position = position[[foot, 1 - foot]]  # right, left
        height = [DOWN, DOWN]
        height[foot] = UP
        for _ in range(3):
            tracker.update(geometry(position, height), np.zeros((1, 2)), NO_FORCE, AHEAD)
        position[foot] = [marks[-1][0] + random.uniform(0.2, 0.6), random.uniform(-0.2, 0.2)]
        report = tracker.update(geometry(position, [DOWN, DOWN]), np.zeros((1, 2)), NO_FORCE, AHEAD)
        assert report.completed[0] and report.foot[0] == foot
        marks.append(list(position[foot]))
        lengths.append(report.length[0])
        drifts.append(report.drift[0])
    marks = np.array(marks)
    np.testing.assert_allclose(lengths, np.diff(marks[1:, 0]))
    assert sum(lengths) == pytest.approx(marks[-1, 0])
    np.testing.assert_allclose(drifts, marks[2:, 1] - marks[:-2, 1])


def test_a_turned_course_turns_the_measured_step():
    tracker = make_tracker(expected=0)
    lifted, landed = (geometry([[0.0, 0.5], [0.0, 0.1]], [height, DOWN]) for height in (UP, DOWN))
    for kinematics in (lifted, lifted, landed):
        report = tracker.update(kinematics, np.zeros((1, 2)), NO_FORCE, np.full(1, np.pi / 2))
    assert report.length[0] == pytest.approx(0.4)  # +y is ahead
    assert report.drift[0] == pytest.approx(0.0)


def test_a_strike_reports_lift_pitch_knee_and_the_force_on_the_other_foot():
    tracker = make_tracker(expected=0)
    advance(tracker, 0.1, 0.0, UP, DOWN, forces=np.array([[0.0, 2.5]]))
    advance(tracker, 0.2, 0.0, 0.12, DOWN, knees=(-1.1, -0.2), forces=np.array([[9.0, 1.0]]))
    report = advance(tracker, 0.3, 0.0, DOWN, DOWN, forces=np.array([[4.0, 1.0]]), pitch=(0.3, 0.0))
    assert report.completed[0]
    assert report.clearance[0] == pytest.approx(0.12)
    assert report.pitch[0] == pytest.approx(0.3)
    assert report.swing_knee[0] == pytest.approx(-1.1)
    assert report.force[0] == pytest.approx(2.5)  # of the left foot, which stood
    between = advance(tracker, 0.3, 0.1, DOWN, UP, forces=np.array([[3.0, 0.0]]), times=2)
    assert not between.completed[0]
    assert (between.clearance[0], between.pitch[0], between.force[0], between.drift[0]) == (0, 0, 0, 0)
    report = advance(tracker, 0.3, 0.5, DOWN, DOWN)
    assert report.force[0] == pytest.approx(4.0)  # of the right foot, from its strike on


def test_a_sole_stays_put_while_the_foot_comes_down_around_its_toes_or_its_heel():
    """Pitched feet whose lowest end is at one place leave the same footprint as the flat foot does there."""
    simulation = HumanoidSimulation(3)
    model = simulation.model.dynamics
    ankle = int(model.joint("right_ankle_y").qposadr[0])
    for row, angle in enumerate((0.0, -0.4, 0.3)):
        simulation.positions[row, ankle] = angle
    kinematics = simulation.kinematics()
    pitches = kinematics.foot_pitch[:, 0]
    assert abs(pitches[0]) < 0.01 and pitches[1] * pitches[2] < 0 and np.abs(pitches[1:]).min() > 0.2
    for row, pitch in enumerate(pitches):
        end = 0.14 if pitch > 0 else -0.07
        touch = kinematics.feet[row, 0, 0] + np.cos(pitch) * end  # x of the end that is lowest
        assert kinematics.soles[row, 0, 0] - touch == pytest.approx(0.035 - end, abs=1e-9)
