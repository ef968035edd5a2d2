"""Declaration of the domain racing_aggressiveness."""

from coachable.envs.racing.domains import racing_domain
from coachable.envs.racing.families import CARS
from coachable.envs.racing.scenarios import rolling_start

DOMAIN = racing_domain(
    "aggressiveness",
    cars=CARS,
    grid={"longitudinal": (0.5, 1.0, 1.5), "lateral": (0.0, 0.25, 0.5, 0.75, 1.0)},
    columns={"contact": ".2%", "place": ".2f"},
    evaluation="races.evaluate_aggressiveness",
    scenarios=rolling_start(CARS),
)
