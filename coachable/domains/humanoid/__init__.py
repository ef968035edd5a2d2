"""Domain of the DeepMind Control humanoid that walks with a requested arm pose and step length."""

from coachable.domains.humanoid.events import humanoid_events
from coachable.domains.humanoid.styles import gait_style_space, humanoid_style_reward, humanoid_style_space

__all__ = ["gait_style_space", "humanoid_events", "humanoid_style_reward", "humanoid_style_space"]
