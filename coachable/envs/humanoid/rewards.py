"""Task reward of the humanoid: move forward along the course, facing it, without waste, head up and torso upright."""

from __future__ import annotations

import numpy as np
from dm_control.utils.rewards import tolerance

WALK_SPEED = (
    1.0,
    1.2,
)  # [m/s]; the suite asks for 1 m/s or more, and what is faster than a walk earns less here, linearly
STAND_HEIGHT = 1.4  # [m], head height above which the suite counts the humanoid as standing
_STAND_MARGIN = STAND_HEIGHT / 4
ALIGNED = 0.9  # cosine of the largest angle that counts as upright, as in the suite, and as facing the course
_UPRIGHT_MARGIN = 0.4
_FACING_MARGIN = 0.9


def move_reward(
    forward_speed: np.ndarray,
    head_height: np.ndarray,
    upright: np.ndarray,
    facing: np.ndarray,
    controls: np.ndarray,
) -> np.ndarray:
    """Task reward `r_move` (Appendix C, DMC Humanoid), within [-1, 1].

    The factors are those of the suite's walk task. What differs: only speed along the course counts, standing still
    earns nothing, walking backwards costs as much as walking forwards earns (a flat zero is where training from
    scratch settles: it learns to step backwards), running earns less than walking, leaning costs more, and the pelvis must face the course. Without
    the last, training settles on a sideways gallop; without a highest speed, on a run with short, quick steps. Effort
    costs up to one half, not one fifth: motors that always push with full force hold no arm between its joint limits.

    Args:
        forward_speed: (N,) speed of the centre of mass along the course [m/s].
        head_height: (N,) [m].
        upright: (N,) cosine between the torso's axis and the vertical.
        facing: (N,) cosine between the pelvis' forward axis and the course.
        controls: (N, 21) motor commands in [-1, 1].

    Returns:
        (N,)
    """
    slow, fast = WALK_SPEED
    moving = np.maximum(1 - np.maximum(0, np.maximum(slow - forward_speed, forward_speed - fast)), -1)
    standing = tolerance(head_height, bounds=(STAND_HEIGHT, np.inf), margin=_STAND_MARGIN)
    for cosine, margin in ((upright, _UPRIGHT_MARGIN), (facing, _FACING_MARGIN)):
        standing = standing * tolerance(
            cosine, bounds=(ALIGNED, np.inf), margin=margin, value_at_margin=0, sigmoid="linear"
        )
    effortless = np.mean(tolerance(controls, margin=1, value_at_margin=0, sigmoid="quadratic"), axis=1)
    return moving * standing * (1 + effortless) / 2
