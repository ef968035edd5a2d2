"""Function that declares the three racing domains, one per family of styles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from coachable.domain import Domain, EnvOption, Recorded
from coachable.domains.racing.families import home_track, racing_family
from coachable.domains.racing.metrics import RacingMeasures
from coachable.domains.racing.stage import RacingStage
from coachable.domains.racing.web_step import racing_web
from coachable.domains.racing.words import WORDS
from coachable.envs.racing.circuit.track import Track
from coachable.envs.racing.env import EPISODE_STEPS
from coachable.envs.racing.physics.simulation import CONTROL_STEP
from coachable.envs.racing.race.garage import GT3_POOL, POOLS
from coachable.envs.racing.race.observation import ACTION_GROUPS, COURSE_POINTS, observation_groups
from coachable.envs.racing.race.scenarios import SOLO, rolling_start
from coachable.scene.renderer import SceneRenderer

# Options of a training's environment that do not apply when an agent is shown or measured.
_OF_TRAINING = ("_target_", "family", "num_envs", "scenarios", "conditions", "weights", "driver")


def racing_domain(
    family: str,
    cars: int,
    grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]],
    columns: Mapping[str, str],
    evaluation: Callable[..., str],
    recorded: Recorded,
    beside: Mapping[str, str] | None = None,
    **options: Any,
) -> Domain:
    """Return the domain of a family of styles.

    Args:
        family: Name of the family: "drift", "resources" or "aggressiveness".
        cars: Number of cars in a race.
        grid: Evaluation grid, as in `Domain`.
        columns: Published columns beside survival, pace, time off course and changes of the steering command.
        evaluation: Function that `coachable evaluate` calls.
        recorded: What the exported page plays.
        beside: Parameters by the measure that tells about them, as in `Domain`.
        **options: Options of the environment that differ from training when an agent is shown and measured.
    """
    make_env, make_space, make_reward = racing_family(family)
    if cars == 1:
        options = {"scenarios": SOLO} | options  # training also launches cars in any direction, or starts off course

    def as_trained(settings: Mapping[str, Any]) -> Domain:
        """Return the domain with the track, car, observation and episode length of a training.

        A driver of several circuits is shown and measured on its family's, and a driver of all cars of the pool with
        its GT3 cars, as in the paper.
        """
        chosen = {name: value for name, value in settings.items() if name not in _OF_TRAINING}
        chosen |= {"compiled": False, "device": "cpu", "track": home_track(family, settings), **options}
        chosen.setdefault("opponents", chosen.get("cars", cars) > 1)
        coached = {}
        if cars == 1 and (met := chosen.pop("cars", 1)) > 1:  # agents trained in traffic are measured alone, too
            coached = {"cars": met, "scenarios": rolling_start(met)}
        pool, points = chosen.get("car") in POOLS, chosen.get("course_points", COURSE_POINTS)
        chosen |= {"car": GT3_POOL} if pool else {}
        shown = partial(make_env, **chosen)
        return replace(
            domain,
            make_env=shown,
            make_web=None if coached or pool else page(shown),
            coached=coached,
            episode_steps=chosen.get("episode_steps", domain.episode_steps),
            observation_groups=observation_groups(chosen["opponents"], pool, points, chosen.get("curvature", False)),
        )

    def page(shown: Callable[..., Any]) -> Callable[..., Any] | None:
        """Return the function that makes the page on which a car drives alone, or None for races of several cars."""
        return partial(racing_web, family=family, told=recorded, make_env=shown) if cars == 1 else None

    angles = ("sideslip", "sideslip_corners", "sideslip_straights") if family == "drift" else ()
    units = {"pace": "m/s", "speed": "m/s", "fuel_per_km": "l"}
    units |= dict.fromkeys(("slip_angle_front", "slip_angle_rear", *angles), "deg")
    units |= dict.fromkeys(("overtake", "defend"), "m/s") if family == "resources" else {}
    units |= dict.fromkeys(("longitudinal_least", "lateral_least"), "m") if family == "aggressiveness" else {}
    domain = Domain(
        name=f"racing_{family}",
        make_env=partial(make_env, **options),
        make_web=page(partial(make_env, **options)),
        make_space=make_space,
        make_reward=make_reward,
        measures=RacingMeasures(family),
        make_renderer=partial(SceneRenderer, RacingStage),
        make_stage=RacingStage,
        window=10.0,
        grid=grid,
        control_step=CONTROL_STEP,
        episode_steps=EPISODE_STEPS,
        columns={"survived": ".0%", "pace": ".1f", "off": ".1%", "steering_change": ".2f"} | dict(columns),
        units=units,
        beside=beside or {},
        observation_groups=observation_groups(cars > 1, pool=False),
        action_groups=ACTION_GROUPS,
        words=WORDS[family],
        as_trained=as_trained,
        evaluation=evaluation,
        recorded=replace(recorded, alike=_alike),
        env_options=(EnvOption("track", Track.from_csv, "CSV file of a circuit"),),
    )
    return domain


def _alike(races: int) -> dict[str, int]:
    return {"copies": races, "controlled": 1}
