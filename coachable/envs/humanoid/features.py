"""Style features of the humanoid: arm angles, and what the gait did in this control step."""

import numpy as np

from coachable.envs.humanoid.gait import StepReport

# Layout of `style_features`: six arm angles [rad], then these.
NUM_ARM_JOINTS = 6
COMPLETED, LENGTH, DURATION, STRIDE_FRACTION, KNEE_MIN, KNEE_MAX, TIMED_OUT = range(NUM_ARM_JOINTS, NUM_ARM_JOINTS + 7)
STYLE_FEATURES_SIZE = TIMED_OUT + 1
# Two more where the style sets the speed, see `HumanoidEnv.styled_speed`.
SPEED, BEARING = STYLE_FEATURES_SIZE, STYLE_FEATURES_SIZE + 1
STYLED_SPEED_SIZE = BEARING + 1

WALK = "walk"
"""Key of further measurements of the walk (see `pack_walk`), which style rewards do not read."""
POWER, FORCE, CLEARANCE, PITCH, DRIFT, SWING_KNEE, FOOT = range(7)
WALK_SIZE = FOOT + 1


def pack_style_features(arms: np.ndarray, report: StepReport, *further: np.ndarray) -> np.ndarray:
    """Pack the raw quantities of the style terms, which do not depend on theta.

    Args:
        arms: (N, 6) arm joint angles [rad].
        report: what the gait did in this control step.
        *further: (N,) forward speed [m/s] and bearing where the style sets the speed, otherwise nothing.

    Returns:
        (N, 13) or (N, 15) float32 in the layout above.
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
    return np.concatenate([arms, np.stack((*step, *further), axis=1)], axis=1).astype(np.float32)


def pack_walk(power: np.ndarray, report: StepReport) -> np.ndarray:
    """Pack what is measured of the walk; all but the power is 0 in control steps without a strike.

    Args:
        power: (N,) mechanical power of the motors [W].
        report: what the gait did in this control step.

    Returns:
        (N, 7) float32: power [W], force [body weights], clearance [m], pitch [rad], drift [m], swing knee [rad], foot.
    """
    walk = (power, report.force, report.clearance, report.pitch, report.drift, report.swing_knee, report.foot)
    return np.stack(walk, axis=1).astype(np.float32)
