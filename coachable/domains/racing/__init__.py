"""Three racing domains, one per family of driving style: saving tyres and fuel, drifting, and margins to other cars."""

from coachable.domains.racing.events import racing_events
from coachable.domains.racing.styles import (
    aggressiveness_style_reward,
    aggressiveness_style_space,
    drift_style_reward,
    drift_style_space,
    resource_style_reward,
    resource_style_space,
)

__all__ = [
    "aggressiveness_style_reward",
    "aggressiveness_style_space",
    "drift_style_reward",
    "drift_style_space",
    "racing_events",
    "resource_style_reward",
    "resource_style_space",
]
