"""Declaration of the domain racing_resources."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from coachable.domain import Domain
from coachable.envs.racing.domains import as_trained
from coachable.envs.racing.env import EPISODE_STEPS
from coachable.envs.racing.families import resource_env
from coachable.envs.racing.measures import RacingMeasures
from coachable.envs.racing.observation import observation_groups
from coachable.envs.racing.render import RacingRenderer
from coachable.envs.racing.simulation import CONTROL_STEP
from coachable.envs.racing.styles import resource_style_reward, resource_style_space


def _as_trained(settings: Mapping[str, Any]) -> Domain:
    return as_trained(DOMAIN, 1, settings)


DOMAIN = Domain(
    name="racing_resources",
    make_env=resource_env,
    make_space=resource_style_space,
    make_reward=resource_style_reward,
    measures=RacingMeasures("resources"),
    make_renderer=RacingRenderer,
    grid=[
        {"overtake": 1.0, "defend": 1.0, "tire": tire, "fuel": fuel}
        for tire, fuel in [(0.0, 0.0)]
        + [(tire, 0.0) for tire in (3000.0, 6000.0, 9000.0, 12000.0)]
        + [(0.0, fuel) for fuel in (26.0, 52.0, 79.0, 105.0)]
    ],
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    columns={"survived": ".0%", "pace": ".1f", "off": ".1%", "wear_per_km": ".4f", "fuel_per_km": ".2f"},
    observation_groups=observation_groups(1, pool=False),
    as_trained=_as_trained,
)
