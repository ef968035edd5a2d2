"""Words of the coach's commands to the humanoid, and the control of its course."""

import math

from torchrl.envs import EnvBase

from coachable.domain import Control, Words
from coachable.styles import Setpoint


def _steer(env: EnvBase, course_deg: float) -> None:
    env.steer(math.radians(course_deg))  # pyright: ignore[reportCallIssue]


COURSE = Control(
    Setpoint("course", -180.0, 180.0, unit="deg", help="direction of walking, left is positive"), _steer, circular=True
)

WORDS = Words(
    vocabulary={
        "": ("walk", "walks", "walking"),
        "pose": ("arm", "hand", "posture", "elbow"),
        "pose=arms_up": (
            *("up", "arms raised", "raise arms", "raise both arms", "lift arms", "hands up", "hands high"),
            *("overhead", "above head", "over head", "reach up", "arms high", "arms in the air", "hands in the air"),
        ),
        "pose=arms_in_front": ("forward", "front", "in front", "ahead", "zombie", "sleepwalker"),
        "pose=t_pose": ("t shape", "t", "sideway", "to side", "out to side", "spread", "aeroplane", "airplane"),
        "step_length": ("step", "stride", "gait", "pace"),
        "step_length=low": ("baby step", "shuffle", "tiptoe"),
        "step_length=high": ("leap", "stretch your legs"),
        "course": ("turn", "heading", "veer", "steer"),
    },
    presets={
        "tightrope": {"pose": "t_pose", "step_length": 0.30},
        "sleepwalker": {"pose": "arms_in_front", "step_length": 0.40},
        "victory lap": {"pose": "arms_up", "step_length": 0.60},
    },
    examples=("shorter steps", "arms up", "0.4 m"),
    terminated="fell",
)
