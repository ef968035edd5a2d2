"""Measures of the humanoid's style, for comparison with the requested one."""

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domains.humanoid.styles import POSES, pose_bounds_deg
from coachable.envs.humanoid import features as layout
from coachable.envs.humanoid.observation import OBSERVATION_GROUPS
from coachable.keys import STYLE, STYLE_FEATURES

POSE_TOLERANCE_DEG = 10.0
LENGTH_TOLERANCE = 0.06  # [m], a step this close to the request complies
SPEED_TOLERANCE = 0.15  # [m/s], a step whose speed is this close to the request complies
_DRIFT_SECONDS = 15.0
FORWARD_SPEED = sum(group.width for group in OBSERVATION_GROUPS[:4])  # first of `com_velocity`


class HumanoidMeasures:
    """Measures of the forward speed, the arms' pose, the step length with its error, and the quality of the walk.

    Of the walk: power [W]; at each strike the largest force under the foot during its stance [body weights], how high
    the foot was lifted and how far its toes pointed down [m, deg], and how far the knee of the swinging leg was bent
    [deg]; over an episode also the difference of the knees of both sides [deg] and how far the walker drifts off the
    course in 15 s [m].

    Attributes:
        lower: (3, 6) joint bounds of the poses less the tolerance [rad].
        upper: (3, 6) joint bounds of the poses plus the tolerance [rad].
    """

    needs = "a footstep"
    """Condition under which compliance can be judged."""

    def __init__(self) -> None:
        bounds = torch.from_numpy(np.deg2rad(pose_bounds_deg())).float()
        slack = float(np.deg2rad(POSE_TOLERANCE_DEG))
        self.lower, self.upper = bounds[..., 0] - slack, bounds[..., 1] + slack

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the measures (N,) of a step by name; see `StyleMeasures.step`.

        A step length is NaN in env-steps without a strike.
        """
        theta = transition.get(STYLE)
        features = transition.get(("next", STYLE_FEATURES))
        pose = theta[:, : len(POSES)].argmax(-1)
        arms = features[:, : layout.NUM_ARM_JOINTS]
        held = ((arms >= self.lower[pose]) & (arms <= self.upper[pose])).all(-1)
        struck = features[:, layout.COMPLETED] > 0
        length = torch.where(struck, features[:, layout.LENGTH], torch.nan)
        observation = transition.get(("next", "observation"))
        walk = transition.get(("next", layout.WALK))
        at_strike = torch.where(struck[:, None], walk, torch.nan)
        knee = -at_strike[:, layout.SWING_KNEE].rad2deg()
        right = at_strike[:, layout.FOOT] == 0
        return {
            "forward_speed": observation[:, FORWARD_SPEED],
            "sideways_speed": observation[:, FORWARD_SPEED + 1],
            "pose_held": held.float(),
            "step_length": length,
            "step_length_error": (length - theta[:, len(POSES)]).abs(),
            "power": walk[:, layout.POWER],
            "strike_force": at_strike[:, layout.FORCE],
            "clearance": at_strike[:, layout.CLEARANCE],
            "strike_pitch": at_strike[:, layout.PITCH].rad2deg(),
            "right_knee": torch.where(right, knee, torch.nan),
            "left_knee": torch.where(right, torch.nan, knee),
        }

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Return means over the steps that count; see `StyleMeasures.summarise`.

        Args:
            record: Outputs of `step` (T, N), by name.
            alive: Steps that count (T, N) bool.

        Returns:
            Values (N,) by name; NaN where an episode has no value.
        """
        means = {name: torch.where(alive, values, torch.nan).nanmean(0) for name, values in record.items()}
        drift = means.pop("sideways_speed").abs() * _DRIFT_SECONDS
        right, left = means.pop("right_knee"), means.pop("left_knee")
        return means | {"drift": drift, "swing_knee": (right + left) / 2, "knee_asymmetry": (right - left).abs()}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool with a strike of the requested length and the arms in pose."""
        return (record["pose_held"] > 0) & (record["step_length_error"] < LENGTH_TOLERANCE)

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool in which a foot struck."""
        return ~torch.isnan(record["step_length"])


class GaitMeasures(HumanoidMeasures):
    """Measures of a humanoid whose style sets the speed: also the speed, and its error at each strike [m/s]."""

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the measures (N,) of a step by name; see `StyleMeasures.step`.

        The error of the speed is that of the step's length over its duration.
        """
        found = super().step(transition)
        requested = transition.get(STYLE)[:, len(POSES) + 1]
        duration = transition.get(("next", STYLE_FEATURES))[:, layout.DURATION]
        error = (found["step_length"] / duration - requested).abs()
        return {"speed": found.pop("forward_speed"), "speed_error": error, **found}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool in which a strike also has the requested speed."""
        return super().complies(record) & (record["speed_error"] < SPEED_TOLERANCE)
