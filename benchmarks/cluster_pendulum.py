"""Gymnasium's pendulum as the environment of a recipe, for `benchmarks/cluster.py`; workers import this module."""

from coachable.gym import GymnasiumEnv


def speed(observation, action, info):
    return abs(observation[2:3])


def pendulum(num_envs: int = 1, seed: int = 0) -> GymnasiumEnv:
    return GymnasiumEnv("Pendulum-v1", speed, num_envs, seed=seed)
