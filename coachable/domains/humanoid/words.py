"""Words of the coach's commands to the humanoid, the control of its course, and pushes."""

import math

import numpy as np
from torchrl.envs import EnvBase

from coachable.domain import Control, Push, Words
from coachable.envs.humanoid.env import HumanoidEnv
from coachable.styles import Setpoint


def _steer(env: EnvBase, course_deg: float) -> None:
    env.steer(math.radians(course_deg))  # pyright: ignore[reportCallIssue]


def _push(env: EnvBase, forward: float, left: float) -> None:
    assert isinstance(env, HumanoidEnv)
    cosine, sine = np.cos(env.course), np.sin(env.course)
    force = [cosine * forward - sine * left, sine * forward + cosine * left, np.zeros(env.num_envs)]
    env.push_torso(np.stack(force, axis=1))


COURSE = Control(
    Setpoint("course", -180.0, 180.0, unit="deg", help="direction of walking, left is positive"),
    _steer,
    circular=True,
    rate=45.0,  # sudden large turns fell the walker
)

PUSH = Push(_push, largest=200.0, unit="N")

_VOCABULARY = {
    "": ("walk", "walks", "walking"),
    "pose": ("arm", "hand", "posture", "elbow"),
    "pose=arms_up": (
        *("up", "up arm", "up hand", "arms raised", "raise arms", "raise both arms", "lift arms"),
        *("hands up", "hands high"),
        *("overhead", "above head", "over head", "reach up", "arms high", "arms in the air", "hands in the air"),
    ),
    "pose=arms_in_front": ("forward", "front", "in front", "ahead", "zombie", "sleepwalker"),
    "pose=t_pose": ("t shape", "t", "sideway", "to side", "out to side", "spread", "aeroplane", "airplane"),
    "step_length": ("step", "stride", "gait", "pace"),
    "step_length=low": ("baby step", "shuffle", "tiptoe"),
    "step_length=high": ("leap", "stretch your legs"),
    "course": ("turn", "heading", "veer", "steer"),
}

WORDS = Words(
    vocabulary=_VOCABULARY,
    presets={
        "tightrope": {"pose": "t_pose", "step_length": 0.30},
        "sleepwalker": {"pose": "arms_in_front", "step_length": 0.40},
        "victory lap": {"pose": "arms_up", "step_length": 0.60},
    },
    examples=("shorter steps", "arms up", "0.4 m"),
    terminated="fell",
)

GAIT_WORDS = Words(
    vocabulary=_VOCABULARY
    | {
        "step_length": ("step", "stride"),
        "speed": ("pace", "tempo", "velocity"),
        "+speed": ("speed up", "brisk", "briskly", "quickly", "hurry up", "get a move on"),
        "-speed": ("slow down", "slowly", "leisurely", "dawdle", "take your time"),
        "speed=low": ("creep", "crawl", "slow to a stop"),
        "speed=high": ("rush", "race"),
    },
    presets={
        **WORDS.presets,
        "stroll": {"step_length": 0.45, "speed": 0.6},
        "march": {"step_length": 0.60, "speed": 1.2},
        "scurry": {"step_length": 0.35, "speed": 1.2},
    },
    examples=("walk faster", "shorter steps", "0.8 m/s"),
    terminated="fell",
)
