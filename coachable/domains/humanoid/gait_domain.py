"""Declaration of the domain humanoid_gait, in which the walking speed is a style, too."""

from dataclasses import replace
from functools import partial

from coachable.domains.humanoid import domain as humanoid
from coachable.domains.humanoid.families import humanoid_family
from coachable.domains.humanoid.metrics import GaitMeasures
from coachable.domains.humanoid.plane import evaluate_gait
from coachable.domains.humanoid.styles import POSES
from coachable.domains.humanoid.web import GAIT_MEASURES, humanoid_web
from coachable.domains.humanoid.words import GAIT_WORDS
from coachable.envs.humanoid.env import HumanoidEnv

_FAMILY = humanoid_family("gait")
_COLUMNS = {name: form for name, form in humanoid.DOMAIN.columns.items() if name != "forward_speed"}

DOMAIN = replace(
    humanoid.DOMAIN,
    name="humanoid_gait",
    make_env=partial(HumanoidEnv, **_FAMILY.options),
    make_space=_FAMILY.make_space,
    measures=GaitMeasures(),
    grid={
        "pose": POSES,
        "step_length": (0.30, 0.39, 0.475, 0.56, 0.65),
        "speed": (0.4, 0.65, 0.9, 1.15, 1.4),
    },
    columns={"survived": ".0%", "measured_speed": ".2f", "speed_error": ".2f"} | _COLUMNS,
    units=dict(humanoid.DOMAIN.units) | {"speed_error": "m/s"},
    words=GAIT_WORDS,
    evaluation=evaluate_gait,
    make_web=partial(humanoid_web, measures=GaitMeasures(), shown=GAIT_MEASURES, step_max=_FAMILY.options["step_max"]),
)
