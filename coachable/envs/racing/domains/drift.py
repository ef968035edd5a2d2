"""Declaration of the domain racing_drift."""

from coachable.envs.racing.domains import racing_domain

DOMAIN = racing_domain(
    "drift",
    cars=1,
    grid={
        "slip_angle_front": (0.0,),
        "slip_angle_rear": (-0.4, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
        "slip_ratio_front": (0.0,),
        "slip_ratio_rear": (0.0,),
    },
    columns={"slip_angle_front": ".1f", "slip_angle_rear": ".1f"},
    evaluation="drifts.evaluate_drift",
)
