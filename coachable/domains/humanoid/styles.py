"""Style spaces of the humanoid and the reward terms of its styles: arm pose, step length, and walking speed."""

import math
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from coachable.envs.humanoid import features as layout
from coachable.envs.humanoid.model import CONTROL_STEP
from coachable.envs.humanoid.rewards import WALK_SPEED
from coachable.ranges import Range
from coachable.styles import Choice, ChoiceTolerance, Setpoint, StyleReward, StyleSpace, StyleTerm, Term, tolerance

STEP_LENGTH_RANGE = (0.30, 0.65)  # [m]
SPEED_RANGE = (0.4, 1.4)  # [m/s]

# Joint bounds of each pose [deg]: right shoulder1, shoulder2, elbow. The left arm mirrors the shoulder joints' signs.
# Centres: the reach of the hand in the pose's direction, maximised within the joint limits; the elbow nearly straight.
_SHOULDER_HALF_WIDTH_DEG = 15.0
_SHOULDER_CENTRES_DEG = {"arms_in_front": (-2.0, 46.0), "arms_up": (-85.0, 16.0), "t_pose": (-56.0, -27.0)}
_ELBOW_BOUNDS_DEG = (-90.0, -70.0)
POSES = tuple(_SHOULDER_CENTRES_DEG)
POSE_MARGIN_DEG = 30.0
_POSE_GUIDE_MARGIN_DEG = 120.0

LENGTH_MARGIN = 0.05  # [m] (paper)
_NEAR_MARGIN, _FAR_MARGIN = 0.25, 0.5  # [m], margins of the gait's guide
STRIDE_FRACTION_BOUNDS = (1 / 3, 2 / 3)
_STRIDE_FRACTION_MARGIN = 1 / 6
SPEED_MARGIN = 0.2  # [m/s]
SPEED_SLACK = (WALK_SPEED[1] - WALK_SPEED[0]) / 2  # [m/s] to either side of the request that costs nothing
_MOST_STEPS = 2.0 / CONTROL_STEP  # control steps for which a step is paid with interest
_MOST_SPEED = 2.0  # [m/s], difference from the request beyond which the guide does not fall further
KNEE_RANGE_DEG = (-145.0, 0.0)
_KNEE_MARGIN_DEG = 30.0


def pose_bounds_deg() -> np.ndarray:
    """Return lower and upper joint bounds of the poses, (3, 6, 2), in the order of `POSES` and `ARM_JOINTS` [deg]."""
    bounds = []
    for shoulder1, shoulder2 in _SHOULDER_CENTRES_DEG.values():
        right = [(c - _SHOULDER_HALF_WIDTH_DEG, c + _SHOULDER_HALF_WIDTH_DEG) for c in (shoulder1, shoulder2)]
        left = [(-upper, -lower) for lower, upper in right]
        bounds.append([*right, _ELBOW_BOUNDS_DEG, *left, _ELBOW_BOUNDS_DEG])
    return np.array(bounds)


def humanoid_style_space() -> StyleSpace:
    """Return the space of arm pose and step length, which are drawn independently and uniformly at a reset.

    The step length is encoded over its range and not divided by its bound (deviation from Appendix C's f(theta)).
    Otherwise 0.30 to 0.65 m would become 0.46 to 1 in the network's input, a small signal among eighty others.
    """
    low, high = STEP_LENGTH_RANGE
    return StyleSpace(
        [
            Choice("pose", POSES, help="how the arms are held"),
            Setpoint(
                "step_length",
                low,
                high,
                unit="m",
                help="distance along the course from one footprint to the next",
                encoding="range",
            ),
        ],
        name="humanoid",
    )


def gait_style_space() -> StyleSpace:
    """Return the space of arm pose, step length and walking speed, which are drawn independently at a reset."""
    low, high = SPEED_RANGE
    speed = Setpoint("speed", low, high, unit="m/s", help="speed of walking", encoding="range")
    return StyleSpace([*humanoid_style_space().parameters, speed], name="humanoid_gait")


def humanoid_style_reward(
    space: StyleSpace,
    *,
    pose_scale: float = 1.0,
    pose_guide_scale: float = 2.0,
    gait_scale: float = 1.0,
    gait_guide_scale: float = 1.5,
    timeout_penalty: float = 0.1,
    step_discount: float = 1.0,
    speed_scale: float = 1.0,
    speed_guide_scale: float = 1.0,
) -> StyleReward:
    """Return the style reward lambda_pose * r_pose + lambda_gait * r_gait (Appendix C, DMC Humanoid) with two guides.

    The paper's tolerances are narrow: far from the target, such as 90 degrees at a shoulder or 0.2 m in a step, an
    improvement earns almost nothing. The guides reward the same quantities over their whole range. With guide scales of
    0 only the paper's terms remain; docs/deviations.md says how they are combined.

    A space with a speed adds two terms, which the paper does not have. `speed` is the closeness of the speed of each
    step, its length over its duration, to the request. `speed_guide` is the loss of `move_reward` for walking at
    another speed than the requested one: with a request of 1.1 m/s, `bearing_reward + speed_guide` equals
    `move_reward`.

    Args:
        space: Style space of the humanoid, with or without a speed.
        pose_scale: Scale lambda_pose of the pose.
        pose_guide_scale: Scale of the pose's guide.
        gait_scale: Scale lambda_gait of the gait.
        gait_guide_scale: Scale of the gait's guide.
        timeout_penalty: Penalty v_m that r_gait subtracts in every control step in which the step is timed out.
        step_discount: Discount gamma of the returns. What a step earns in each of its control steps is paid at the
            strike with the interest that makes up for the delay, so that quick steps are not preferred. 1 pays none.
        speed_scale: Scale of the speed of steps.
        speed_guide_scale: Scale of the speed's guide.

    Raises:
        ValueError: If `step_discount` lies outside (0, 1].
    """
    Range("(0, 1]").check("step_discount", step_discount)
    bounds = torch.from_numpy(np.deg2rad(pose_bounds_deg()))

    def arms(margin_deg: float, sigmoid: str, value_at_margin: float) -> ChoiceTolerance:
        """Return the mean closeness of the six arm joints to the requested bounds."""
        joints, margin = slice(0, layout.NUM_ARM_JOINTS), math.radians(margin_deg)
        return ChoiceTolerance("pose", joints, bounds[..., 0], bounds[..., 1], margin, sigmoid, value_at_margin)

    def balance(features: Tensor) -> Tensor:
        """Return 1 where both feet contribute to the stride, falling to 0 where one of them does not."""
        return tolerance(
            features[..., layout.STRIDE_FRACTION], *STRIDE_FRACTION_BOUNDS, _STRIDE_FRACTION_MARGIN, "linear", 0.0
        )

    def gait(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
        length, target = features[..., layout.LENGTH], style["step_length"]
        score = tolerance(length, target, target, LENGTH_MARGIN, "long_tail") * balance(features)
        knee_low, knee_high = (math.radians(angle) for angle in KNEE_RANGE_DEG)
        knee_margin = math.radians(_KNEE_MARGIN_DEG)
        score = score * tolerance(features[..., layout.KNEE_MIN], knee_low, math.inf, knee_margin, "linear", 0.0)
        score = score * tolerance(features[..., layout.KNEE_MAX], -math.inf, knee_high, knee_margin, "linear", 0.0)
        return _per_control_step(features, score, step_discount) - timeout_penalty * features[..., layout.TIMED_OUT]

    def gait_guide(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
        error = (features[..., layout.LENGTH] - style["step_length"]).abs()
        # Without the balance a long step and a short one in turn would earn more than two of medium length.
        near = tolerance(error, margin=_NEAR_MARGIN, sigmoid="long_tail") * balance(features)
        # Negative values penalise a gallop, in which one foot is always behind the other.
        far = (1 - error / _FAR_MARGIN).clamp(min=-1.0)
        return _per_control_step(features, 0.5 * (near + far), step_discount)

    def speed(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
        stepped = features[..., layout.LENGTH] / features[..., layout.DURATION].clamp(min=CONTROL_STEP)
        score = tolerance(stepped, style["speed"], style["speed"], SPEED_MARGIN, "long_tail")
        return _per_control_step(features, score, step_discount)

    def speed_guide(features: Tensor, style: Mapping[str, Tensor]) -> Tensor:
        difference = (features[..., layout.SPEED] - style["speed"]).abs()
        return -features[..., layout.BEARING] * (difference - SPEED_SLACK).clamp(min=0.0, max=_MOST_SPEED)

    terms: dict[str, StyleTerm] = {
        "pose": arms(POSE_MARGIN_DEG, "long_tail", 0.1),
        "pose_guide": arms(_POSE_GUIDE_MARGIN_DEG, "linear", 0.0),
        "gait": Term(gait, parameters=("step_length",)),
        "gait_guide": Term(gait_guide, parameters=("step_length",)),
    }
    scales = {"pose": pose_scale, "pose_guide": pose_guide_scale, "gait": gait_scale, "gait_guide": gait_guide_scale}
    if "speed" in space:
        terms |= {name: Term(term, ("speed",)) for name, term in (("speed", speed), ("speed_guide", speed_guide))}
        scales |= {"speed": speed_scale, "speed_guide": speed_guide_scale}
    return StyleReward(space, terms, scales=scales)


def _per_control_step(features: Tensor, score: Tensor, discount: float) -> Tensor:
    """Return what a completed step of D control steps earns if each of them earns `score`, which is paid at its end.

    With a discount below 1 this is `score * sum_(k=0)^(D-1) discount^(-k)`, whose discounted value at the beginning of
    the step is that of `score` in every control step, and D counts for two seconds at most.
    """
    steps = features[..., layout.DURATION] / CONTROL_STEP
    if discount < 1.0:
        rate = -math.log(discount)
        steps = ((steps.clamp(max=_MOST_STEPS) * rate).exp() - 1) / math.expm1(rate)
    return features[..., layout.COMPLETED] * steps * score
