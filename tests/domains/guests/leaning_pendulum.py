"""Gymnasium's pendulum, which can be asked to lean."""

from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss

from coachable import training
from coachable.domain import Domain
from coachable.gym import GymnasiumEnv
from coachable.networks import make_critic, make_gaussian_actor
from coachable.styles import Setpoint, SetpointTolerance, StyleReward, StyleSpace
from coachable.transforms import TaskImpersonation


def make_space() -> StyleSpace:
    return StyleSpace([Setpoint("lean", -0.35, 0.35, unit="rad", help="angle from upright")])


def make_reward(space: StyleSpace) -> StyleReward:
    return StyleReward(space, {"lean": SetpointTolerance("lean", 0, margin=0.3)}, {"lean": 8.0})


def make_env(num_envs: int = 8, seed: int = 0) -> EnvBase:
    make = partial(gymnasium.make, "Pendulum-v1", render_mode="rgb_array")
    return GymnasiumEnv(make, lambda seen, action, info: [np.arctan2(seen[1], seen[0])], num_envs, seed=seed)


DOMAIN = Domain("leaning_pendulum", make_env, make_space, make_reward)


def train(run: Path, frames: int = 20_000) -> None:
    """Train by soft actor-critic with relabelled styles; the run's folder is an agent for every command."""
    space = make_space()
    sizes = {"obs_dim": 3, "action_dim": 1, "widths": [64, 64]}
    actor = make_gaussian_actor(space=space, **sizes)
    critics = [make_critic(space=space, **sizes) for _ in range(2)]
    loss = SACLoss(actor, critics, action_spec=Bounded(-1.0, 1.0, (1,)), loss_function="l2")
    loss.make_value_estimator(gamma=0.98)
    relabel = TaskImpersonation(make_reward(space), n=2)
    network = {"actor": {"_target_": "coachable.networks.make_gaussian_actor", **sizes}}
    agent = {"domain": DOMAIN.name, "space": space, "actor": actor, "loss_module": loss, "network": network}
    styled = partial(DOMAIN.styled_env, space, 8, transforms=[training.EpisodeSums()])
    training.Trainer(
        collector=training.make_collector(styled, actor, frames_per_batch=8, init_random_frames=200),
        replay=TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), transform=relabel),
        learner=training.Learner(loss),
        settings=training.TrainSettings(frames, warmup_frames=200, utd_ratio=0.25),
        log=training.MetricsLog(run),
        progress=training.Progress(frames),
        checkpoints=training.CheckpointStore(run / "checkpoints"),
        describe=partial(training.agent_state, **agent, config={}),
    ).run()
