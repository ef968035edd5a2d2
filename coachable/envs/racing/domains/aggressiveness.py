"""Declaration of the domain racing_aggressiveness."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from coachable.domain import Domain
from coachable.envs.racing.domains import as_trained
from coachable.envs.racing.env import EPISODE_STEPS
from coachable.envs.racing.families import rival_env
from coachable.envs.racing.measures import RacingMeasures
from coachable.envs.racing.observation import observation_groups
from coachable.envs.racing.render import RacingRenderer
from coachable.envs.racing.simulation import CONTROL_STEP
from coachable.envs.racing.styles import aggressiveness_style_reward, aggressiveness_style_space


def _as_trained(settings: Mapping[str, Any]) -> Domain:
    return as_trained(DOMAIN, 5, settings)


DOMAIN = Domain(
    name="racing_aggressiveness",
    make_env=rival_env,
    make_space=aggressiveness_style_space,
    make_reward=aggressiveness_style_reward,
    measures=RacingMeasures("aggressiveness"),
    make_renderer=RacingRenderer,
    grid={"longitudinal": (0.5, 1.0, 1.5), "lateral": (0.0, 0.25, 0.5, 0.75, 1.0)},
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    columns={"survived": ".0%", "pace": ".1f", "off": ".1%", "contact": ".2%", "place": ".2f"},
    observation_groups=observation_groups(5, pool=False),
    as_trained=_as_trained,
)
