"""Gymnasium both ways: `StyleWrapper` makes its environments coachable, `GymnasiumEnv` trains them here."""

from coachable.gym.env import GymnasiumEnv
from coachable.gym.features import Features
from coachable.gym.wrapper import StyleWrapper

__all__ = ["Features", "GymnasiumEnv", "StyleWrapper"]
