"""Task reward of the humanoid: move forward along the course, facing it, without waste, head up and torso upright."""

from __future__ import annotations

import numpy as np
from dm_control.utils.rewards import tolerance

WALK_SPEED = 1.0  # [m/s], the suite's walking speed
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
    """Task reward `r_move` (Appendix C, DMC Humanoid), within [0, 1].

    The factors are those of the suite's walk task. What differs: only speed along the course counts, standing still
    earns nothing, leaning costs more, and the pelvis must face the course; without that, training settles on a
    sideways gallop.

    Args:
        forward_speed: (N,) speed of the centre of mass along the course [m/s].
        head_height: (N,) [m].
        upright: (N,) cosine between the torso's axis and the vertical.
        facing: (N,) cosine between the pelvis' forward axis and the course.
        controls: (N, 21) motor commands in [-1, 1].

    Returns:
        (N,)
    """
    moving = tolerance(
        forward_speed, bounds=(WALK_SPEED, np.inf), margin=WALK_SPEED, value_at_margin=0, sigmoid="linear"
    )
    standing = tolerance(head_height, bounds=(STAND_HEIGHT, np.inf), margin=_STAND_MARGIN)
    for cosine, margin in ((upright, _UPRIGHT_MARGIN), (facing, _FACING_MARGIN)):
        standing = standing * tolerance(
            cosine, bounds=(ALIGNED, np.inf), margin=margin, value_at_margin=0, sigmoid="linear"
        )
    effortless = np.mean(tolerance(controls, margin=1, value_at_margin=0, sigmoid="quadratic"), axis=1)
    return moving * standing * (4 + effortless) / 5
