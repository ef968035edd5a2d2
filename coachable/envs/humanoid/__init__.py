"""The DeepMind Control humanoid, walking with a requested arm pose and step length."""

from coachable.envs.humanoid.env import HumanoidEnv
from coachable.envs.humanoid.events import humanoid_events
from coachable.envs.humanoid.styles import humanoid_style_reward, humanoid_style_space

__all__ = ["HumanoidEnv", "humanoid_events", "humanoid_style_reward", "humanoid_style_space"]
