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
    """Return the task reward `r_move` (paper, Appendix C, DMC Humanoid), within [-1, 1].

    The factors are those of the suite's walk task. What differs, and what training settles on without it:

    - only speed along the course counts, and walking backwards costs what walking forwards earns (stepping backwards,
      where the reward would be flat);
    - running earns less than walking (a run with short, quick steps);
    - leaning costs more, and the pelvis must face the course (a crouched sideways gallop);
    - effort costs up to one half, not one fifth (arms pressed against their joint limits, whatever the style).

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
