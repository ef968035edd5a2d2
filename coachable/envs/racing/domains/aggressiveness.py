"""Declaration of the domain racing_aggressiveness."""

from coachable.envs.racing.domains import racing_domain

DOMAIN = racing_domain(
    "aggressiveness",
    cars=5,
    grid={"longitudinal": (0.5, 1.0, 1.5), "lateral": (0.0, 0.25, 0.5, 0.75, 1.0)},
    columns={"contact": ".2%", "place": ".2f"},
    evaluation="races.evaluate_aggressiveness",
)
