"""Style features of the humanoid: arm angles, and what the gait did in this control step."""

from __future__ import annotations

import numpy as np

from coachable.envs.humanoid.gait import StepReport

# Layout of `style_features`: six arm angles [rad], then these.
NUM_ARM_JOINTS = 6
COMPLETED, LENGTH, DURATION, STRIDE_FRACTION, KNEE_MIN, KNEE_MAX, TIMED_OUT = range(NUM_ARM_JOINTS, NUM_ARM_JOINTS + 7)
STYLE_FEATURES_SIZE = TIMED_OUT + 1


def pack_style_features(arms: np.ndarray, report: StepReport) -> np.ndarray:
    """Pack the raw quantities of both style terms, which do not depend on theta.

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
