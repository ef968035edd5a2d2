"""The DeepMind Control humanoid, batched."""

from coachable.envs.humanoid.env import HumanoidEnv

__all__ = ["HumanoidEnv"]
