"""What is measured of a walker, from features written by hand."""

import math

import pytest
import torch
from tensordict import TensorDict

from coachable.domains.humanoid import gait_style_space, humanoid_style_space
from coachable.domains.humanoid.metrics import GaitMeasures, HumanoidMeasures
from coachable.domains.humanoid.styles import POSES, pose_bounds_deg
from coachable.envs.humanoid.features import (
    CLEARANCE,
    COMPLETED,
    DURATION,
    FOOT,
    FORCE,
    LENGTH,
    PITCH,
    POWER,
    STYLE_FEATURES_SIZE,
    SWING_KNEE,
    WALK,
    WALK_SIZE,
)
from coachable.envs.humanoid.observation import OBSERVATION_GROUPS
from coachable.keys import STYLE, STYLE_FEATURES


def transition(pose="t_pose", asked=0.5, angles=None, struck=True, length=0.5, speed=1.2, walk=None):
    space = humanoid_style_space()
    features = torch.zeros(1, STYLE_FEATURES_SIZE)
    centre = torch.from_numpy(pose_bounds_deg()[POSES.index(pose)].mean(1)).float()
    features[0, :6] = torch.deg2rad(centre if angles is None else angles)
    features[0, COMPLETED], features[0, LENGTH] = float(struck), length
    observation = torch.zeros(1, sum(group.width for group in OBSERVATION_GROUPS))
    first = 0
    for group in OBSERVATION_GROUPS:
        if group.name == "com_velocity":
            observation[0, first], observation[0, first + 1] = speed, 0.1
        first += group.width
    measured = torch.zeros(1, WALK_SIZE)
    for column, value in (walk or {}).items():
        measured[0, column] = value
    following = {STYLE_FEATURES: features, "observation": observation, WALK: measured}
    return TensorDict({STYLE: space.make(pose=pose, step_length=asked)[None], "next": following}, [1])


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("joint", range(6))
def test_arms_are_in_pose_within_ten_degrees_of_its_bounds(pose, joint):
    bounds = torch.from_numpy(pose_bounds_deg()[POSES.index(pose)]).float()
    for beyond, held in ((9.9, 1.0), (10.1, 0.0)):
        for side, sign in ((0, -1), (1, 1)):
            angles = bounds.mean(1)
            angles[joint] = bounds[joint, side] + sign * beyond
            row = HumanoidMeasures().step(transition(pose, angles=angles))
            assert row["pose_held"].item() == held, (side, beyond)


def test_a_strike_is_measured_and_nothing_between_strikes():
    measures = HumanoidMeasures()
    row = measures.step(transition(asked=0.4, length=0.45))
    assert row["step_length"].item() == pytest.approx(0.45)
    assert row["step_length_error"].item() == pytest.approx(0.05)
    assert row["forward_speed"].item() == pytest.approx(1.2)
    between = measures.step(transition(struck=False))
    assert math.isnan(between["step_length"]) and math.isnan(between["step_length_error"])
    assert not measures.complies(between).any()


@pytest.mark.parametrize("length, complies", [(0.445, True), (0.555, True), (0.43, False), (0.57, False)])
def test_a_step_within_six_centimetres_complies(length, complies):
    measures = HumanoidMeasures()
    assert measures.complies(measures.step(transition(asked=0.5, length=length))).item() is complies
    wrong = torch.full((6,), 170.0)
    assert not measures.complies(measures.step(transition(asked=0.5, length=0.5, angles=wrong))).item()


def test_means_are_over_the_steps_that_count():
    nan = torch.nan
    record = {"forward_speed": torch.tensor([[1.0, 1.0], [3.0, 1.0], [9.0, 1.0]])}
    record["step_length"] = torch.tensor([[nan, nan], [0.4, nan], [0.9, nan]])
    record["sideways_speed"] = torch.tensor([[0.1, -0.2], [-0.3, -0.2], [9.0, -0.2]])
    record["right_knee"] = torch.tensor([[60.0, nan], [nan, nan], [nan, nan]])
    record["left_knee"] = torch.tensor([[nan, nan], [80.0, 50.0], [10.0, nan]])
    means = HumanoidMeasures().summarise(record, torch.tensor([[True, True], [True, True], [False, True]]))
    assert means["forward_speed"].tolist() == [2.0, 1.0]
    assert means["step_length"][0] == pytest.approx(0.4) and means["step_length"][1].isnan()
    assert means["drift"].tolist() == pytest.approx([1.5, 3.0])  # [m] in 15 s
    assert means["swing_knee"][0] == 70.0 and means["knee_asymmetry"][0] == 20.0
    assert means["knee_asymmetry"][1].isnan()  # one leg only
    assert "right_knee" not in means and "sideways_speed" not in means


@pytest.mark.parametrize("foot, side", [(0, "right_knee"), (1, "left_knee")])
def test_the_walk_is_measured_at_strikes_and_its_power_in_every_step(foot, side):
    walk = {POWER: 300.0, FORCE: 1.4, CLEARANCE: 0.05, PITCH: -0.1, SWING_KNEE: -math.pi / 3, FOOT: foot}
    row = HumanoidMeasures().step(transition(walk=walk))
    for name, value in (("power", 300.0), ("strike_force", 1.4), ("clearance", 0.05), (side, 60.0)):
        assert row[name].item() == pytest.approx(value)
    assert row["strike_pitch"].item() == pytest.approx(math.degrees(-0.1))
    assert row["sideways_speed"].item() == pytest.approx(0.1)
    between = HumanoidMeasures().step(transition(struck=False, walk=walk))
    assert between["power"].item() == 300.0
    assert all(math.isnan(between[name]) for name in ("strike_force", "clearance", "strike_pitch", side))


def test_walking_is_judged_by_footsteps():
    nan = float("nan")
    record = {
        "pose_held": torch.tensor([[1.0], [1.0], [0.0], [1.0]]),
        "step_length": torch.tensor([[nan], [0.5], [0.5], [0.3]]),
        "step_length_error": torch.tensor([[nan], [0.01], [0.01], [0.21]]),
    }
    measures = HumanoidMeasures()
    assert measures.judged(record)[:, 0].tolist() == [False, True, True, True]
    assert measures.complies(record)[:, 0].tolist() == [False, True, False, False]


@pytest.mark.parametrize(("asked", "complies"), [(1.0, True), (1.14, True), (1.16, False), (0.84, False)])
def test_the_speed_of_a_step_is_compared_with_the_request(asked, complies):
    walked = transition(pose="arms_in_front", asked=0.5, length=0.5, speed=0.9)
    walked["next", STYLE_FEATURES][0, DURATION] = 0.5  # [s]
    walked[STYLE] = gait_style_space().make(step_length=0.5, speed=asked)[None]
    measures = GaitMeasures()
    row = measures.step(walked)
    assert row["speed"].item() == pytest.approx(0.9) and "forward_speed" not in row
    assert row["speed_error"].item() == pytest.approx(abs(asked - 1.0), abs=1e-6)
    assert measures.complies(row).item() is complies
    walked["next", STYLE_FEATURES][0, COMPLETED] = 0.0
    assert math.isnan(measures.step(walked)["speed_error"])
