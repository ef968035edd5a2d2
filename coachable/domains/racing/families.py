"""The environments that the three families of style are trained in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from coachable.domains.racing.styles import (
    aggressiveness_style_reward,
    aggressiveness_style_space,
    drift_style_reward,
    drift_style_space,
    resource_style_reward,
    resource_style_space,
)
from coachable.envs.racing.circuit.circuits import load_track
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.physics.cars import Resources, load_car
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.rivals import Rivals
from coachable.envs.racing.race.scenarios import Conditions, drift_scenarios, race_scenarios
from coachable.envs.racing.race.task import TaskWeights
from coachable.styles import StyleReward, StyleSpace

RIVALS_GRIP = 0.97  # of the fastest scripted opponents; the slowest use 0.8
TYRE_HEAT = 900.0  # [m] that all grip is worth for the minute that heat takes to go
AGENTS, CARS = 3, 5  # in a race of the aggressiveness family


def drift_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """Street car on Ridge, launched anywhere in any direction; it may slide backwards for ten seconds."""
    defaults: dict[str, Any] = {
        "track": "ridge",
        "car": "street",
        "scenarios": drift_scenarios(),
        "wrong_way_time": 10.0,
    }
    return RacingEnv(num_envs, **(defaults | options))


def resource_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """X2019 on Lakeside, tyres and fuel of any state; stints last about ten laps.

    With several `cars`, all are agents, or one is, among scripted ones, where `num_envs` is no multiple of them.
    """
    cars = options.get("cars", 1)
    if num_envs % cars:
        options = {"controlled": 1, "driver": _line_follower(options, "lakeside", "x2019")[1]} | options
    defaults: dict[str, Any] = {
        "track": "lakeside",
        "car": "x2019",
        "conditions": Conditions.resources(),
        "resources": Resources.calibrated("gt3" if options.get("car") == "gt3" else "x2019"),
        "weights": TaskWeights(tyre_heat=TYRE_HEAT),
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


def rival_env(num_envs: int = AGENTS * 21, **options: Any) -> RacingEnv:
    """Three agents among two rivals, scripted or copies of the policy (`Rivals`), GT3 cars, all kinds of starts.

    One agent among four rivals where `num_envs` is no multiple of three.
    """
    course, driver = _line_follower(options, "endurance", "gt3")
    space = aggressiveness_style_space()
    defaults: dict[str, Any] = {
        "cars": CARS,
        "controlled": AGENTS if num_envs % AGENTS == 0 else 1,
        "driver": Rivals(driver, (space.low, space.high), slowest=0.8 / RIVALS_GRIP),
        "car": "gt3",
        "scenarios": race_scenarios(CARS),
    }
    return RacingEnv(num_envs, **{**defaults, **options, "track": course})


def _line_follower(options: Mapping[str, Any], track: str, car: str) -> tuple[Track, LineFollower]:
    """The track of an environment with these options, and the fastest scripted opponent on it."""
    chosen = options.get("track", track)
    course = load_track(chosen) if isinstance(chosen, str) else chosen
    return course, LineFollower(course, load_car(options.get("car", car)), grip=RIVALS_GRIP, lanes=(0.0, 2.2, -2.2))


class Family(NamedTuple):
    """What a family of styles is trained with."""

    make_env: Callable[..., RacingEnv]
    make_space: Callable[[], StyleSpace]
    make_reward: Callable[..., StyleReward]


_FAMILIES = {
    "drift": Family(drift_env, drift_style_space, drift_style_reward),
    "resources": Family(resource_env, resource_style_space, resource_style_reward),
    "aggressiveness": Family(rival_env, partial(aggressiveness_style_space, AGENTS), aggressiveness_style_reward),
}
FAMILIES = tuple(_FAMILIES)


def racing_family(family: str) -> Family:
    """Return the family of that name.

    Raises:
        ValueError: naming the families.
    """
    if family not in _FAMILIES:
        raise ValueError(f"unknown family {family!r}: expected drift, resources or aggressiveness")
    return _FAMILIES[family]


def family_env(num_envs: int = 64, *, family: str, **options: Any) -> RacingEnv:
    """The environment of a family.

    Args:
        num_envs: cars that the agent drives.
        family: drift, resources or aggressiveness.
        **options: of `RacingEnv`.
    """
    return racing_family(family).make_env(num_envs, **options)


def family_style(family: str) -> tuple[StyleSpace, Callable[..., StyleReward]]:
    """Style space and `make_style_reward(space, **settings)` of a family."""
    found = racing_family(family)
    return found.make_space(), found.make_reward
