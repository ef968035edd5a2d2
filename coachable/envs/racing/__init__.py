"""Tyre-limited car racing in batched torch: wear, fuel, several cars, three families of driving style."""

from coachable.envs.racing.circuits import load_track
from coachable.envs.racing.env import RacingEnv
from coachable.envs.racing.styles import (
    aggressiveness_style_reward,
    aggressiveness_style_space,
    drift_style_reward,
    drift_style_space,
    resource_style_reward,
    resource_style_space,
)
from coachable.envs.racing.track import Track

__all__ = [
    "RacingEnv",
    "Track",
    "aggressiveness_style_reward",
    "aggressiveness_style_space",
    "drift_style_reward",
    "drift_style_space",
    "load_track",
    "resource_style_reward",
    "resource_style_space",
]
