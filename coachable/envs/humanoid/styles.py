"""Styles of the humanoid: three arm poses and a step length, and the reward terms that ask for them."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from coachable.envs.humanoid.gait import StepReport
from coachable.envs.humanoid.model import CONTROL_STEP
from coachable.styles import Choice, ChoiceTolerance, Setpoint, StyleReward, StyleSpace, Term, tolerance

STEP_LENGTH_RANGE = (0.30, 0.65)  # [m]

# Joint bounds of each pose [deg]: right shoulder1, shoulder2, elbow. The left arm mirrors the shoulder joints' signs.
# Centres: the reach of the hand in the pose's direction, maximised within the joint limits; the elbow nearly straight.
_SHOULDER_HALF_WIDTH_DEG = 15.0
_SHOULDER_CENTRES_DEG = {
    "arms_in_front": (-2.0, 46.0),
    "arms_up": (-85.0, 16.0),
    "t_pose": (-56.0, -27.0),
}
_ELBOW_BOUNDS_DEG = (-90.0, -70.0)
POSES = tuple(_SHOULDER_CENTRES_DEG)
POSE_MARGIN_DEG = 30.0

STRIDE_FRACTION_BOUNDS = (1 / 3, 2 / 3)
_STRIDE_FRACTION_MARGIN = 1 / 6
KNEE_RANGE_DEG = (-145.0, 0.0)
_KNEE_MARGIN_DEG = 10.0

# Layout of `style_features`: six arm angles [rad], then these.
NUM_ARM_JOINTS = 6
COMPLETED, LENGTH, DURATION, STRIDE_FRACTION, KNEE_MIN, KNEE_MAX, TIMED_OUT = range(NUM_ARM_JOINTS, NUM_ARM_JOINTS + 7)
STYLE_FEATURES_SIZE = TIMED_OUT + 1


def pack_style_features(arms: np.ndarray, report: StepReport) -> np.ndarray:
    """Raw quantities of both style terms under any theta.

    Args:
        arms: (N, 6) arm joint angles [rad].
        report: what the gait did in this control step.

    Returns:
        (N, 13) float32 in the layout above.
    """
    step = (
        report.completed,
        report.length,
        report.duration,
        report.stride_fraction,
        report.knee_min,
        report.knee_max,
        report.timed_out,
    )
    return np.concatenate([arms, np.stack(step, axis=1)], axis=1).astype(np.float32)


def pose_bounds_deg() -> np.ndarray:
    """Joint bounds (3 poses, 6 arm joints, lower and upper) [deg], in the order of `POSES` and `ARM_JOINTS`."""
    bounds = []
    for shoulder1, shoulder2 in _SHOULDER_CENTRES_DEG.values():
        right = [(c - _SHOULDER_HALF_WIDTH_DEG, c + _SHOULDER_HALF_WIDTH_DEG) for c in (shoulder1, shoulder2)]
        left = [(-upper, -lower) for lower, upper in right]
        bounds.append([*right, _ELBOW_BOUNDS_DEG, *left, _ELBOW_BOUNDS_DEG])
    return np.array(bounds)


def humanoid_style_space() -> StyleSpace:
    """Arm pose and step length, drawn independently and uniformly at reset.

    The step length is encoded over its range, not divided by its bound (deviation from Appendix C's f(theta)): 0.30 to
    0.65 m would otherwise reach the network as 0.46 to 1, a signal small beside the other eighty inputs.
    """
    low, high = STEP_LENGTH_RANGE
    return StyleSpace(
        [
            Choice("pose", POSES, help="how the arms are held"),
            Setpoint(
                "step_length", low, high, unit="m", help="distance between the feet at a strike", encoding="range"
            ),
        ],
        name="humanoid",
    )


def humanoid_style_reward(
    space: StyleSpace,
    *,
    pose_scale: float = 1.0,
    gait_scale: float = 1.0,
    length_margin: float = 0.05,
    wide_margin: float = 0.25,
    far_margin: float = 1.0,
    guide_share: float = 0.6,
    timeout_penalty: float = 0.1,
) -> StyleReward:
    """Style part of the reward: lambda_pose * r_pose + lambda_gait * r_gait (Appendix C, DMC Humanoid).

    Args:
        space: the humanoid's style space.
        pose_scale: lambda_pose.
        gait_scale: lambda_gait.
        length_margin: margin of the step-length tolerance [m] (paper).
        wide_margin: margin of a second, wide tolerance [m] that leads to about the right length.
        far_margin: margin of a third, linear one [m] that leads out of galloping, where one foot always lands behind
            the other and a long tail is flat.
        guide_share: share of these two, in equal parts, in the length score. Stride and knees do not gate them; 0 is
            the paper's reward.
        timeout_penalty: v_m, taken off in every control step in which the step is timed out.
    """
    bounds = torch.from_numpy(np.deg2rad(pose_bounds_deg()))
    knee_low, knee_high = (math.radians(angle) for angle in KNEE_RANGE_DEG)
    knee_margin = math.radians(_KNEE_MARGIN_DEG)

    pose = ChoiceTolerance(
        "pose",
        slice(0, NUM_ARM_JOINTS),
        lower=bounds[..., 0],
        upper=bounds[..., 1],
        margin=math.radians(POSE_MARGIN_DEG),
        sigmoid="long_tail",
    )

    def gait(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
        """Closeness of a completed step to the requested length, paid for the control steps that it took.

        The scaling by duration makes the reward per unit of time independent of the cadence.
        """
        length, target = features[..., LENGTH], style["step_length"]
        narrow = tolerance(length, target, target, margin=length_margin, sigmoid="long_tail")
        even = tolerance(
            features[..., STRIDE_FRACTION],
            *STRIDE_FRACTION_BOUNDS,
            margin=_STRIDE_FRACTION_MARGIN,
            sigmoid="linear",
            value_at_margin=0.0,
        )
        knees = tolerance(features[..., KNEE_MIN], knee_low, math.inf, margin=knee_margin, sigmoid="long_tail")
        knees = knees * tolerance(
            features[..., KNEE_MAX], -math.inf, knee_high, margin=knee_margin, sigmoid="long_tail"
        )
        # The guide leads from no steps at all to steps of about the right length, so it asks for nothing else.
        wide = tolerance(length, target, target, margin=wide_margin, sigmoid="long_tail")
        far = tolerance(length, target, target, margin=far_margin, sigmoid="linear", value_at_margin=0.0)
        score = (1 - guide_share) * narrow * even * knees + guide_share * 0.5 * (wide + far)
        control_steps = features[..., DURATION] / CONTROL_STEP
        earned = features[..., COMPLETED] * control_steps * score
        return earned - timeout_penalty * features[..., TIMED_OUT]

    return StyleReward(
        space,
        {"pose": pose, "gait": Term(gait, parameters=("step_length",))},
        scales={"pose": pose_scale, "gait": gait_scale},
    )
