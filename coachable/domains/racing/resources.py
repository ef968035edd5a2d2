"""Declaration of the domain racing_resources."""

from coachable.domain import Recorded
from coachable.domains.racing.domain import racing_domain
from coachable.domains.racing.stints import evaluate_resources

DOMAIN = racing_domain(
    "resources",
    cars=1,
    grid=[
        {"overtake": 1.0, "defend": 1.0, "tire": tire, "fuel": fuel}
        for tire, fuel in [(0.0, 0.0)]
        + [(tire, 0.0) for tire in (3000.0, 6000.0, 9000.0, 12000.0)]
        + [(0.0, fuel) for fuel in (26.0, 52.0, 79.0, 105.0)]
    ],
    columns={"wear_per_km": ".2%", "fuel_per_km": ".2f"},
    evaluation=evaluate_resources,
    beside={"wear_per_km": "tire", "fuel_per_km": "fuel"},
    recorded=Recorded(
        grid={
            "overtake": (1.0,),
            "defend": (1.0,),
            "tire": (0.0, 3000.0, 6000.0, 9000.0, 12000.0),
            "fuel": (0.0, 52.0, 105.0),
        },
        seconds=45.0,
        title="A driver who saves what you ask for",
        summary="Ask for saved tyres and saved fuel, and see what the car uses of both.",
    ),
)
