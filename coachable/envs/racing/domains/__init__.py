"""Declarations of the three racing domains, one per family of style."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from coachable.domain import Domain
from coachable.envs.racing.observation import COURSE_POINTS, observation_groups


def as_trained(domain: Domain, cars: int, settings: Mapping[str, Any]) -> Domain:
    """A domain with the track, the car and the observation of a training, and its length of an episode.

    Args:
        domain: to vary.
        cars: of a race, unless the settings say otherwise.
        settings: `env` of the training's configuration.
    """
    options = {name: value for name, value in settings.items() if name not in ("_target_", "family", "num_envs")}
    options |= {"compiled": False, "device": "cpu"}
    pool = options.get("car") == "pool"
    points = options.get("course_points", COURSE_POINTS)
    return replace(
        domain,
        make_env=partial(domain.make_env, **options),
        episode_steps=options.get("episode_steps", domain.episode_steps),
        observation_groups=observation_groups(options.get("cars", cars), pool, points),
    )
