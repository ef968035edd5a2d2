"""The cart-pole of the DeepMind Control suite, which can be asked where to balance."""

from functools import partial
from pathlib import Path

from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import CatTensors, Compose, DMControlEnv, DoubleToFloat, EnvBase, SerialEnv, TransformedEnv
from torchrl.objectives import SACLoss

from coachable import training
from coachable.domain import Domain
from coachable.networks import make_critic, make_gaussian_actor
from coachable.styles import Setpoint, SetpointTolerance, StyleReward, StyleSpace
from coachable.transforms import StyleFeatures, TaskImpersonation


def make_space() -> StyleSpace:
    return StyleSpace([Setpoint("place", -1.0, 1.0, unit="m", help="where the cart stands, right is positive")])


def make_reward(space: StyleSpace) -> StyleReward:
    return StyleReward(space, {"place": SetpointTolerance("place", 0, margin=1.0)})


def make_env(num_envs: int = 8, seed: int = 0) -> EnvBase:
    carts = SerialEnv(num_envs, lambda: DMControlEnv("cartpole", "balance"))
    place = StyleFeatures(lambda after: after["position"][..., :1], 1)
    observation = CatTensors(["position", "velocity"], "observation")
    single = DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"])
    env = TransformedEnv(carts, Compose(place, observation, single))
    env.set_seed(seed)
    return env


DOMAIN = Domain("placed_cartpole", make_env, make_space, make_reward)


def train(run: Path, frames: int = 20_000) -> None:
    """Train by soft actor-critic with relabelled styles; the run's folder is an agent for every command."""
    space = make_space()
    sizes = {"obs_dim": 5, "action_dim": 1, "widths": [64, 64]}
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
