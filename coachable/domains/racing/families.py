"""Training environments, style spaces and style rewards of the three families of styles."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from coachable.domains.racing import styles
from coachable.envs.racing.circuit.circuits import SETS, load_tracks
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.physics.cars import Resources, load_car
from coachable.envs.racing.race.driver import LineFollower
from coachable.envs.racing.race.garage import POOLS
from coachable.envs.racing.race.rivals import Rivals
from coachable.envs.racing.race.scenarios import Conditions, drift_scenarios, race_scenarios
from coachable.envs.racing.race.task import TaskWeights
from coachable.styles import StyleReward, StyleSpace

RIVALS_GRIP = 0.97  # of the fastest scripted opponents; the slowest use 0.8
TYRE_HEAT = 900.0  # [m], progress that all grip is worth during the minute in which heat dissipates
AGENTS, CARS = 3, 5  # in a race of the aggressiveness family
CAR = {"drift": "street", "resources": "x2019", "aggressiveness": "gt3"}  # of each family
HOME = {"drift": "ridge", "resources": "lakeside", "aggressiveness": "endurance"}  # circuit of each family


def _drift_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """Make the environment of drifting: a street car on Ridge, launched anywhere in any direction."""
    options = {
        "track": HOME["drift"],
        "car": CAR["drift"],
        "scenarios": drift_scenarios(),
        "wrong_way_time": 10.0,  # [s], for which the car may slide backwards
    } | options
    return RacingEnv(num_envs, **options)


def _resource_env(num_envs: int = 64, **options: Any) -> RacingEnv:
    """Make the environment of saving: an X2019 on Lakeside with random tyres and fuel, for stints of about ten laps.

    The agent drives all cars, or one of each race if `num_envs` is not a multiple of `cars`; the others are scripted.
    A `ValueError` is raised for a car without calibrated rates, because its savings could not be evaluated.
    """
    rates = Resources.calibrated(typical_car("resources", options))
    cars = options.get("cars", 1)
    controlled = options.get("controlled") or (1 if num_envs % cars else cars)
    if controlled < cars:
        driver = _line_follower(options, "resources")[1]
        options = {"driver": driver} | options | {"controlled": controlled}
    defaults: dict[str, Any] = {
        "track": HOME["resources"],
        "car": CAR["resources"],
        "conditions": Conditions.resources(),
        "resources": rates,
        "weights": TaskWeights(tyre_heat=TYRE_HEAT),
    }
    return RacingEnv(num_envs, **(defaults | options))


def _rival_env(num_envs: int = AGENTS * 21, **options: Any) -> RacingEnv:
    """Make races of GT3 cars against rivals, which are scripted or copies of the policy, from all kinds of starts.

    The agent drives three of the five cars of each race, or one if `num_envs` is no multiple of three or `cars` is
    less.
    """
    tracks, driver = _line_follower(options, "aggressiveness")
    space = styles.aggressiveness_style_space()
    defaults: dict[str, Any] = {
        "cars": CARS,
        "controlled": AGENTS if num_envs % AGENTS == 0 and options.get("cars", CARS) >= AGENTS else 1,
        "driver": Rivals(driver, (space.low, space.high), slowest=0.8 / RIVALS_GRIP),
        "car": CAR["aggressiveness"],
        "opponents": True,
        "scenarios": race_scenarios(CARS),
    }
    return RacingEnv(num_envs, **{**defaults, **options, "track": tracks})


def _line_follower(options: Mapping[str, Any], family: str) -> tuple[tuple[Track, ...], LineFollower]:
    """Return the circuits of an environment with these options, and the fastest scripted opponent on them."""
    tracks, car = load_tracks(options.get("track", HOME[family])), load_car(typical_car(family, options))
    return tracks, LineFollower(tracks, car, grip=RIVALS_GRIP, lanes=(0.0, 2.2, -2.2))


class Family(NamedTuple):
    """Functions that make the environment, the style space and the style reward of a family."""

    make_env: Callable[..., RacingEnv]
    make_space: Callable[[], StyleSpace]
    make_reward: Callable[..., StyleReward]


_FAMILIES = {
    "drift": Family(_drift_env, styles.drift_style_space, styles.drift_style_reward),
    "resources": Family(_resource_env, styles.resource_style_space, styles.resource_style_reward),
    "aggressiveness": Family(
        _rival_env, partial(styles.aggressiveness_style_space, AGENTS), styles.aggressiveness_style_reward
    ),
}


def racing_family(family: str) -> Family:
    """Return a family by its name.

    Raises:
        ValueError: If there is no such family.
    """
    if family not in _FAMILIES:
        raise ValueError(f"unknown family {family!r}: expected drift, resources or aggressiveness")
    return _FAMILIES[family]


def family_env(num_envs: int = 64, *, family: str, **options: Any) -> RacingEnv:
    """Make the training environment of a family.

    Args:
        num_envs: Number of cars that the agent drives.
        family: Name of the family: "drift", "resources" or "aggressiveness".
        **options: Options of `RacingEnv`.

    Raises:
        ValueError: If there is no such family.
    """
    return racing_family(family).make_env(num_envs, **options)


def home_track(family: str, settings: Mapping[str, Any]) -> str:
    """Return the name of the circuit on which an agent is measured and shown: its only one, or its family's.

    Args:
        family: Name of the family.
        settings: Options of the environment that the agent was trained in.
    """
    tracks = training_tracks(family, settings)
    return tracks[0] if len(tracks) == 1 else HOME[family]


def training_tracks(family: str, settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the circuits that an agent was trained on.

    Args:
        family: Name of the family.
        settings: Options of the environment that the agent was trained in.
    """
    track = settings.get("track", HOME[family])
    return SETS.get(track, (track,)) if isinstance(track, str) else tuple(track)


def typical_car(family: str, settings: Mapping[str, Any]) -> str:
    """Return the shipped car that an agent drove, or the one after which its pool is made.

    Args:
        family: Name of the family.
        settings: Options of the environment that the agent was trained in.
    """
    car = settings.get("car", CAR[family])
    return "gt3" if car in POOLS else car
