"""Task reward of the humanoid: move forward along the course, facing it, without waste, head up and torso upright."""

from typing import Any

import numpy as np
from dm_control.utils.rewards import tolerance

from coachable.envs.humanoid.gait import StepReport
from coachable.envs.humanoid.model import CONTROL_STEP

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
    standing, effortless = _bearing(head_height, upright, facing, controls)
    return moving * standing * (1 + effortless) / 2


def bearing_reward(
    head_height: np.ndarray, upright: np.ndarray, facing: np.ndarray, controls: np.ndarray
) -> np.ndarray:
    """Return the factors of `move_reward` without that of the speed.

    It is the task reward if the style sets the speed.

    Args:
        head_height: (N,) height of the head [m].
        upright: (N,) z component of the torso's upward axis.
        facing: (N,) cosine between the pelvis' forward axis and the course.
        controls: (N, 21) actions in [-1, 1].

    Returns:
        (N,) in [0, 1].
    """
    standing, effortless = _bearing(head_height, upright, facing, controls)
    return standing * (1 + effortless) / 2


def _bearing(head_height: np.ndarray, upright: np.ndarray, facing: np.ndarray, controls: np.ndarray) -> tuple[Any, Any]:
    standing = tolerance(head_height, bounds=(STAND_HEIGHT, np.inf), margin=_STAND_MARGIN)
    for cosine, margin in ((upright, _UPRIGHT_MARGIN), (facing, _FACING_MARGIN)):
        standing = standing * tolerance(
            cosine, bounds=(ALIGNED, np.inf), margin=margin, value_at_margin=0, sigmoid="linear"
        )
    return standing, np.mean(tolerance(controls, margin=1, value_at_margin=0, sigmoid="quadratic"), axis=1)


COSTS = ("power", "impact", "clearance", "strike_pitch", "drift")
"""Names of the costs that `walk_costs` returns."""
_WORST = 3.0  # of any of them in a control step
_POWER = 1000.0  # [W] that cost 1
_SOFT, _HARD = 1.5, 6.5  # forces under a foot [body weights] that cost 0 and 1
_LOW, _HIGH = 0.06, 0.21  # clearances [m] that cost 0 and 1
_TOES_UP = np.deg2rad(25)  # pitch of a foot at a heel strike, up to which it costs nothing, as of one that lands flat
_TILTED = np.deg2rad(20)  # pitch beyond that, or toes first, that costs 1
_DRIFT = 0.10  # [m] to either side over a stride that cost 1


def walk_costs(
    power: np.ndarray, forces: np.ndarray, clearance: np.ndarray, report: StepReport
) -> dict[str, np.ndarray]:
    """Return the costs of an unnatural walk.

    A cost is 0 at best and 1 where the walk looks wrong. None of the costs is in the paper. A cost that is measured
    once per step is multiplied by the number of control steps that the step took.

    Args:
        power: (N,) mechanical power of the motors [W].
        forces: (N, 2) largest force under each foot in this control step [body weights].
        clearance: (N, 2) height of the lowest point of each foot [m].
        report: what the gait did in this control step.

    Returns:
        (N,) by the names of `COSTS`.
    """
    steps = report.duration / CONTROL_STEP
    costs = {
        "power": power / _POWER,
        "impact": (forces.max(axis=1) - _SOFT) / (_HARD - _SOFT),
        "clearance": (clearance.max(axis=1) - _LOW) / (_HIGH - _LOW),
        "strike_pitch": np.maximum(report.pitch, -report.pitch - _TOES_UP) / _TILTED,
        "drift": np.abs(report.drift) / _DRIFT,
    }
    costs = {name: np.clip(cost, 0.0, _WORST) for name, cost in costs.items()}
    return costs | {name: steps * costs[name] for name in ("strike_pitch", "drift")}
