"""Declaration of the domain racing_drift."""

from coachable.domain import Recorded
from coachable.domains.racing.domain import racing_domain
from coachable.domains.racing.drifts import evaluate_drift
from coachable.envs.racing.race.features import DRIFT_NAMES

_NONE: dict[str, float] = dict.fromkeys(DRIFT_NAMES, 0.0)
_ALL: dict[str, float] = dict.fromkeys(DRIFT_NAMES, 5.0)
_REAR = ("slip_angle_rear", "slip_ratio_rear")  # the car slides if both are asked for

DOMAIN = racing_domain(
    "drift",
    cars=1,
    grid=[*({**_NONE, **dict.fromkeys(_REAR, weight)} for weight in (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)), _ALL],
    columns={"sideslip_corners": ".1f", "sideslip_straights": ".1f", "turned_per_km": ".2f"},
    evaluation=evaluate_drift,
    beside={"sideslip_corners": "slip_angle_rear", "sideslip_straights": "slip_angle_rear"},
    recorded=Recorded(
        grid={**{name: (0.0,) for name in DRIFT_NAMES}, **dict.fromkeys(_REAR, (0.0, 1.0, 2.0, 3.0, 5.0))},
        title="A car that drifts when you ask",
        summary="Ask for sliding rear tyres, and see how far the car goes sideways.",
    ),
)
