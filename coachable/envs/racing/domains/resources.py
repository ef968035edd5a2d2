"""Declaration of the domain racing_resources."""

from __future__ import annotations

from coachable.domain import Domain
from coachable.envs.racing.env import EPISODE_STEPS
from coachable.envs.racing.families import resource_env
from coachable.envs.racing.measures import RacingMeasures
from coachable.envs.racing.observation import observation_groups
from coachable.envs.racing.render import RacingRenderer
from coachable.envs.racing.simulation import CONTROL_STEP
from coachable.envs.racing.styles import resource_style_reward, resource_style_space

DOMAIN = Domain(
    name="racing_resources",
    make_env=resource_env,
    make_space=resource_style_space,
    make_reward=resource_style_reward,
    measures=RacingMeasures("resources"),
    make_renderer=RacingRenderer,
    grid={
        "overtake": (1.0,),
        "defend": (1.0,),
        "tire": (0.0, 3000.0, 6000.0, 9000.0, 12000.0),
        "fuel": (0.0, 26.0, 52.0, 79.0, 105.0),
    },
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    columns={"survived": ".0%", "pace": ".1f", "off": ".1%", "wear_per_km": ".4f", "fuel_per_km": ".2f"},
    observation_groups=observation_groups(1, pool=False),
)
