"""Gymnasium's pendulum, which can be asked to lean."""

from functools import partial

import gymnasium
import numpy as np
from torchrl.envs import EnvBase

from coachable.domain import Domain
from coachable.gym import GymnasiumEnv
from coachable.styles import Setpoint, SetpointTolerance, StyleReward, StyleSpace


def make_space() -> StyleSpace:
    return StyleSpace([Setpoint("lean", -0.35, 0.35, unit="rad", help="angle from upright")])


def make_reward(space: StyleSpace) -> StyleReward:
    return StyleReward(space, {"lean": SetpointTolerance("lean", 0, margin=0.3)}, {"lean": 8.0})


def make_env(num_envs: int = 8, seed: int = 0) -> EnvBase:
    make = partial(gymnasium.make, "Pendulum-v1", render_mode="rgb_array")
    return GymnasiumEnv(make, lambda seen, action, info: [np.arctan2(seen[1], seen[0])], num_envs, seed=seed)


DOMAIN = Domain("leaning_pendulum", make_env, make_space, make_reward)
