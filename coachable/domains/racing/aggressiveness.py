"""Declaration of the domain racing_aggressiveness."""

from coachable.domain import Recorded
from coachable.domains.racing.domain import racing_domain
from coachable.domains.racing.families import CARS
from coachable.domains.racing.races import evaluate_aggressiveness
from coachable.envs.racing.race.scenarios import rolling_start

DOMAIN = racing_domain(
    "aggressiveness",
    cars=CARS,
    grid={"longitudinal": (0.5, 1.0, 1.5), "lateral": (0.0, 0.25, 0.5, 0.75, 1.0)},
    columns={"contact": ".2%", "place": ".2f"},
    evaluation=evaluate_aggressiveness,
    recorded=Recorded(
        columns={
            "longitudinal_least": ".1f",
            "lateral_least": ".1f",
            "complied": ".1%",
            "contact": ".1%",
            "place": ".1f",
            "pace": ".1f",
            "off": ".1%",
        },
        title="A driver who keeps the distance that you ask for",
        summary="Ask for room ahead, behind and beside, and see how close the car comes to the others.",
    ),
    scenarios=rolling_start(CARS),
    controlled=1,  # a race ends when one of its agents retires, which must not cut other styles short
)
