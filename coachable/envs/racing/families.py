"""The environments that the three families of style are trained in (racing.md, sections 1 and 5.3)."""

from __future__ import annotations

from typing import Any

from coachable.envs.racing.circuits import load_track
from coachable.envs.racing.driver import LineFollower
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.parameters import Resources, load_car
from coachable.envs.racing.scenarios import Conditions, drift_scenarios, rolling_start

WEAR_RATE, FUEL_RATE = 9.0, 2.0  # a stint of about ten laps of Lakeside in the X2019
RIVALS_GRIP = 0.85  # of the scripted opponents


def drift_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """Street car on Ridge, launched anywhere in any direction."""
    defaults: dict[str, Any] = {"track": "ridge", "car": "street", "scenarios": drift_scenarios()}
    return RacingEnv(num_envs, **(defaults | options))


def resource_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """X2019 on Lakeside, tyres and fuel of any state."""
    defaults: dict[str, Any] = {
        "track": "lakeside",
        "car": "x2019",
        "conditions": Conditions.resources(),
        "resources": Resources(wear=WEAR_RATE, fuel=FUEL_RATE),
    }
    return RacingEnv(num_envs, **(defaults | options))


def race_env(num_envs: int = 65, **options: Any) -> RacingEnv:
    """Five cars of one model from the pool on Endurance, on any compound; the agent drives all of them."""
    defaults: dict[str, Any] = {
        "cars": 5,
        "track": "endurance",
        "car": "pool",
        "conditions": Conditions.any_compound(),
    }
    return RacingEnv(num_envs, **(defaults | options))


def rival_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """One agent among four scripted GT3 rivals, rolling start: a row is a race."""
    track, car = options.get("track", "endurance"), options.get("car", "gt3")
    course = load_track(track) if isinstance(track, str) else track
    rivals = LineFollower(course, load_car(car), grip=RIVALS_GRIP, lanes=(0.0, 2.2, -2.2))
    defaults: dict[str, Any] = {
        "cars": 5,
        "controlled": 1,
        "driver": rivals,
        "track": course,
        "car": car,
        "scenarios": rolling_start(5),
    }
    settings: dict[str, Any] = {**defaults, **options, "track": course}
    return RacingEnv(num_envs, **settings)
