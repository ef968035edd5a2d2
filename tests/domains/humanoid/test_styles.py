"""Poses by forward kinematics, and the style terms by hand."""

import itertools
import math

import numpy as np
import pytest
import torch

from coachable.domains.humanoid import gait_style_space, humanoid_style_reward, humanoid_style_space
from coachable.domains.humanoid.families import humanoid_family
from coachable.domains.humanoid.styles import POSES, pose_bounds_deg
from coachable.envs.humanoid.features import (
    BEARING,
    COMPLETED,
    DURATION,
    KNEE_MAX,
    KNEE_MIN,
    LENGTH,
    SPEED,
    STRIDE_FRACTION,
    STYLE_FEATURES_SIZE,
    STYLED_SPEED_SIZE,
    TIMED_OUT,
)
from coachable.envs.humanoid.model import CONTROL_STEP, NUM_POSITIONS
from coachable.envs.humanoid.rewards import move_reward
from coachable.envs.humanoid.simulation import HumanoidSimulation

SPACE = humanoid_style_space()
SHOULDER_HEIGHT = 0.06  # [m] above the torso's origin


def hands_in_pose(pose):
    """Right and left hand relative to the torso [m], arms at the centre of the pose's bounds."""
    simulation = HumanoidSimulation(1)
    positions = simulation.positions
    positions[0, 7:] = 0.0
    centre = pose_bounds_deg()[POSES.index(pose)].mean(axis=1)
    positions[0, simulation.model.arm_positions] = np.deg2rad(centre)
    kinematics = simulation.kinematics()
    assert simulation.state.shape[1] >= 1 + NUM_POSITIONS
    return (kinematics.extremities[0] - kinematics.torso_position[0])[[2, 0]]


def test_arms_in_front_are_ahead_at_shoulder_height():
    for hand in hands_in_pose("arms_in_front"):
        assert hand[0] > 0.45
        assert abs(hand[2] - SHOULDER_HEIGHT) < 0.15
        assert abs(hand[1]) < 0.35


def test_t_pose_hands_are_out_sideways_at_shoulder_height():
    right, left = hands_in_pose("t_pose")
    assert right[1] < -0.55
    assert left[1] > 0.55
    for hand in (right, left):
        assert abs(hand[2] - SHOULDER_HEIGHT) < 0.15
        assert abs(hand[0]) < 0.3


def test_arms_up_hands_are_well_above_the_head():
    for hand in hands_in_pose("arms_up"):
        assert hand[2] > 0.19 + 0.09 + 0.1  # head centre, head radius, and 10 cm


def test_poses_mirror_left_and_right():
    for pose in POSES:
        right, left = hands_in_pose(pose)
        np.testing.assert_allclose(right * [1, -1, 1], left, atol=1e-6)


def test_elbows_are_bent_by_70_to_90_degrees_and_shoulders_have_15_either_side():
    for right, left in zip(pose_bounds_deg()[:, :3], pose_bounds_deg()[:, 3:], strict=True):
        assert right[2].tolist() == left[2].tolist() == [-90.0, -70.0]
        np.testing.assert_allclose(right[:2, 1] - right[:2, 0], 30.0)
        np.testing.assert_allclose(left[:2], -right[:2, ::-1])
    t_pose = [[-71.0, -41.0], [-42.0, -12.0]]
    np.testing.assert_allclose(pose_bounds_deg()[POSES.index("t_pose"), :2], t_pose)


def test_pose_bounds_lie_in_the_joint_ranges():
    ranges = np.rad2deg(HumanoidSimulation(1).model.arm_ranges)
    centres = pose_bounds_deg().mean(axis=2)
    assert (centres >= ranges[:, 0] - 1e-3).all()
    assert (centres <= ranges[:, 1] + 1e-3).all()


def features(values=None):
    """Arms at the centre of the T-pose, and `values` by index of the feature."""
    row = torch.zeros(1, STYLE_FEATURES_SIZE)
    row[0, :6] = torch.from_numpy(np.deg2rad(pose_bounds_deg().mean(-1)[POSES.index("t_pose")]))
    for index, value in (values or {}).items():
        row[0, index] = value
    return row


def a_step(length, fraction=0.5, duration=0.5, knee_min=-1.0, knee_max=-0.1):
    step = {COMPLETED: 1, LENGTH: length, DURATION: duration, STRIDE_FRACTION: fraction}
    return features(step | {KNEE_MIN: knee_min, KNEE_MAX: knee_max})


def terms(row, **style):
    reward = humanoid_style_reward(SPACE)
    theta = SPACE.make(pose="t_pose", step_length=0.5) if not style else SPACE.make(**style)
    return {name: value.item() for name, value in reward.terms_of(row, theta[None]).items()}


def test_pose_term_is_one_within_bounds_and_a_tenth_at_the_margin():
    row = features()
    assert terms(row)["pose"] == 1.0
    row[0, 0] += math.radians(15 + 30)  # half width and margin of one joint of six
    assert terms(row)["pose"] == pytest.approx((5 + 0.1) / 6, abs=1e-6)
    assert terms(row)["pose_guide"] == pytest.approx((5 + 1 - 30 / 120) / 6, abs=1e-6)


def test_gait_terms_pay_an_exact_step_for_the_control_steps_it_took():
    for duration in (0.25, 0.5):
        paid = terms(a_step(0.5, duration=duration))
        assert paid["gait"] == pytest.approx(duration / CONTROL_STEP)
        assert paid["gait_guide"] == pytest.approx(duration / CONTROL_STEP)


def test_gait_terms_at_the_papers_margin_of_five_centimetres():
    paid = terms(a_step(0.45))
    assert paid["gait"] == pytest.approx(20 * 0.1, rel=1e-5)
    near, far = 1 / (1 + 9 * (0.05 / 0.25) ** 2), 1 - 0.05 / 0.5
    assert paid["gait_guide"] == pytest.approx(20 * 0.5 * (near + far), rel=1e-5)


def test_uneven_strides_and_bent_or_overstretched_knees_cost():
    assert terms(a_step(0.5, fraction=2 / 3))["gait"] == pytest.approx(20)
    assert terms(a_step(0.5, fraction=3 / 4))["gait"] == pytest.approx(10, rel=1e-4)
    assert terms(a_step(0.5, fraction=5 / 6))["gait"] == pytest.approx(0, abs=1e-5)
    assert terms(a_step(0.5, fraction=3 / 4))["gait_guide"] == pytest.approx(15, rel=1e-4)
    long, short = terms(a_step(0.5, fraction=1.0)), terms(a_step(0.0, fraction=0.0))
    assert long["gait_guide"] + short["gait_guide"] < 2 * terms(a_step(0.25))["gait_guide"]
    assert terms(a_step(0.5, knee_min=math.radians(-160)))["gait"] == pytest.approx(10, rel=1e-4)
    assert terms(a_step(0.5, knee_max=math.radians(10)))["gait"] == pytest.approx(40 / 3, rel=1e-4)


def test_a_foot_that_lands_behind_gains_by_landing_less_far_behind():
    scores = [terms(a_step(length, fraction=0.0))["gait_guide"] for length in (-0.4, -0.2, 0.0, 0.2)]
    assert all(b - a > 1 for a, b in itertools.pairwise(scores))
    assert scores[0] < 0


def test_no_step_earns_nothing_and_a_time_out_costs():
    assert terms(features())["gait"] == terms(features())["gait_guide"] == 0.0
    assert terms(features({TIMED_OUT: 1}))["gait"] == pytest.approx(-0.1)


def test_reward_sums_the_scaled_terms_and_is_the_papers_without_guides():
    theta = SPACE.make(pose="t_pose", step_length=0.5)[None]
    reward = humanoid_style_reward(SPACE, pose_scale=0.5, gait_scale=2.0, pose_guide_scale=3.0, gait_guide_scale=0.1)
    assert reward(a_step(0.5), theta).item() == pytest.approx(0.5 + 3.0 + 2.0 * 20.0 + 0.1 * 20.0)
    paper = humanoid_style_reward(SPACE, pose_guide_scale=0.0, gait_guide_scale=0.0)
    assert paper(a_step(0.45), theta).item() == pytest.approx(1.0 + 20 * 0.1, rel=1e-5)


def test_with_a_step_discount_the_discounted_reward_does_not_depend_on_the_duration():
    discount, theta = 0.97, SPACE.make(step_length=0.5)[None]
    reward = humanoid_style_reward(SPACE, step_discount=discount)
    for steps in (1, 8, 20, 80):
        step = a_step(0.5)
        step[0, DURATION] = steps * CONTROL_STEP
        for name in ("gait", "gait_guide"):
            paid = reward.terms_of(step, theta)[name].item()
            evenly = sum(discount**k for k in range(steps))  # 1 in each control step
            assert discount ** (steps - 1) * paid == pytest.approx(evenly, rel=1e-5)
    longest = reward.terms_of(step, theta)["gait"].item()
    step[0, DURATION] = 1000.0
    assert reward.terms_of(step, theta)["gait"].item() == pytest.approx(longest), "nobody is paid for waiting"


@pytest.mark.parametrize("discount", [0.0, 1.1, math.nan])
def test_a_step_discount_outside_its_range_is_refused(discount):
    with pytest.raises(ValueError, match="step_discount is"):
        humanoid_style_reward(SPACE, step_discount=discount)


GAIT_SPACE = gait_style_space()


def speed_terms(asked, values):
    row = torch.zeros(1, STYLED_SPEED_SIZE)
    for index, value in values.items():
        row[0, index] = value
    theta = GAIT_SPACE.make(speed=asked)[None]
    paid = humanoid_style_reward(GAIT_SPACE).terms_of(row, theta)
    return {name: paid[name].item() for name in ("speed", "speed_guide")}


def test_the_gait_has_a_speed_beside_pose_and_step_length():
    assert GAIT_SPACE.names == ("pose", "step_length", "speed")
    assert (GAIT_SPACE["speed"].low, GAIT_SPACE["speed"].high) == (0.4, 1.4)
    torch.testing.assert_close(GAIT_SPACE.encode(GAIT_SPACE.make(speed=1.4))[-1], torch.tensor(1.0))
    longest = GAIT_SPACE["step_length"].high / GAIT_SPACE["speed"].low  # [s]
    assert humanoid_family("gait").options["step_max"] > longest, "the slowest step that may be asked for is in time"
    with pytest.raises(ValueError, match="unknown family 'run': expected steps or gait"):
        humanoid_family("run")


@pytest.mark.parametrize(("asked", "closeness"), [(0.8, 1.0), (1.0, 0.1), (0.6, 0.1)])
def test_the_speed_of_a_step_is_paid_for_the_control_steps_it_took(asked, closeness):
    step = {COMPLETED: 1, LENGTH: 0.4, DURATION: 0.5}  # 0.8 m/s
    assert speed_terms(asked, step)["speed"] == pytest.approx(20 * closeness, rel=1e-4)
    assert speed_terms(asked, {LENGTH: 0.0})["speed"] == 0.0


@pytest.mark.parametrize(
    ("speed", "expected"), [(0.6, 0.0), (0.7, 0.0), (0.5, 0.0), (0.9, -0.2), (0.0, -0.5), (-9.0, -2.0), (9.0, -2.0)]
)
def test_the_guide_costs_what_the_speed_is_off_by_more_than_a_tenth(speed, expected):
    assert speed_terms(0.6, {SPEED: speed, BEARING: 1.0})["speed_guide"] == pytest.approx(expected, abs=1e-6)
    assert speed_terms(0.6, {SPEED: speed, BEARING: 0.5})["speed_guide"] == pytest.approx(expected / 2, abs=1e-6)


@pytest.mark.parametrize("speed", [-2.0, -0.5, 0.0, 0.7, 1.0, 1.1, 1.2, 1.9])
def test_bearing_and_guide_are_the_movement_reward_at_its_own_speed(speed):
    values = [np.array([value]) for value in (speed, 1.5, 1.0, 1.0)]
    paid = speed_terms(1.1, {SPEED: speed, BEARING: 1.0})["speed_guide"]
    assert 1.0 + paid == pytest.approx(move_reward(*values, np.zeros((1, 21)))[0], abs=1e-6)


def test_the_best_speed_is_the_requested_one():
    speeds = np.linspace(0.2, 1.6, 57)
    for asked in (0.4, 0.8, 1.4):
        paid = [
            sum(speed_terms(asked, {SPEED: v, BEARING: 1, COMPLETED: 1, LENGTH: v / 2, DURATION: 0.5}).values())
            for v in speeds
        ]
        assert speeds[np.argmax(paid)] == pytest.approx(asked)


def test_a_space_without_a_speed_has_no_terms_for_it():
    reward = humanoid_style_reward(SPACE, speed_scale=9.0)
    assert list(reward.terms) == ["pose", "pose_guide", "gait", "gait_guide"]
    assert list(humanoid_style_reward(GAIT_SPACE).terms) == [*reward.terms, "speed", "speed_guide"]
