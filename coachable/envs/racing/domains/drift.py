"""Declaration of the domain racing_drift."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from coachable.domain import Domain
from coachable.envs.racing.domains import as_trained
from coachable.envs.racing.env import EPISODE_STEPS
from coachable.envs.racing.families import drift_env
from coachable.envs.racing.measures import RacingMeasures
from coachable.envs.racing.observation import observation_groups
from coachable.envs.racing.render import RacingRenderer
from coachable.envs.racing.simulation import CONTROL_STEP
from coachable.envs.racing.styles import drift_style_reward, drift_style_space


def _as_trained(settings: Mapping[str, Any]) -> Domain:
    return as_trained(DOMAIN, 1, settings)


DOMAIN = Domain(
    name="racing_drift",
    make_env=drift_env,
    make_space=drift_style_space,
    make_reward=drift_style_reward,
    measures=RacingMeasures("drift"),
    make_renderer=RacingRenderer,
    grid={
        "slip_angle_front": (0.0,),
        "slip_angle_rear": (-0.4, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
        "slip_ratio_front": (0.0,),
        "slip_ratio_rear": (0.0,),
    },
    control_step=CONTROL_STEP,
    episode_steps=EPISODE_STEPS,
    columns={"survived": ".0%", "pace": ".1f", "off": ".1%", "slip_angle_front": ".1f", "slip_angle_rear": ".1f"},
    observation_groups=observation_groups(1, pool=False),
    as_trained=_as_trained,
)
