"""Train the DMC cheetah to run at a requested speed: your own environment, made coachable without touching the library.

python recipes/cheetah_speed.py                           three to six minutes on one core
python recipes/cheetah_speed.py preset=smoke              every part once, within a minute
python recipes/cheetah_speed.py loss=cat_rac seed=1       another loss; see --help for all groups

docs/guides/bring_your_own_environment.md goes through this file.
"""

from typing import Any

import recipe_boxes as boxes
import torch
from absl import logging
from recipe_config import run_recipe
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import CatTensors, Compose, DMControlEnv, DoubleToFloat, EnvBase, SerialEnv, Transform, TransformedEnv

from coachable.fast import accelerate
from coachable.keys import STYLE_FEATURES, TASK_REWARD
from coachable.replay import PredicateEvents
from coachable.styles import Setpoint, SetpointTolerance, StyleReward, StyleSpace
from coachable.training.episodes import EpisodeSums
from coachable.training.trainer import Trainer
from coachable.training.weights import initialise_from
from coachable.transforms import CoachableEnv, StyleRewardTransform, StyleSampler, TaskImpersonation

PITCH = 1  # in the suite's position
SPEED = 0  # in the suite's velocity, and in the style features


def cheetah_space() -> StyleSpace:
    """Return the style space of the cheetah: one speed."""
    return StyleSpace([Setpoint("speed", 0.0, 3.0, unit="m/s", help="forward speed")], name="cheetah")


def cheetah_style_reward(space: StyleSpace, *, scale: float = 2.0, margin: float = 3.0) -> StyleReward:
    """Return a style reward that is highest at the requested speed and falls linearly to 0.

    The margin is as wide as the range, because a flat reward would not tell a slow run from standing still.

    Args:
        space: The style space.
        scale: Reward per step at the requested speed.
        margin: Difference from the requested speed at which the reward is 0 [m/s].
    """
    term = SetpointTolerance("speed", SPEED, margin=margin, sigmoid="linear", value_at_margin=0.0)
    return StyleReward(space, {"speed": term}, scales={"speed": scale})


class CheetahTask(Transform):
    """Transform that adds the outputs of a coachable environment: the task reward and the style features.

    The task is to stay upright with little effort, at any speed.
    """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        upright = next_tensordict["position"][..., PITCH].cos()
        effort = tensordict["action"].square().mean(-1)
        next_tensordict[TASK_REWARD] = (0.5 * upright - 0.1 * effort).float().unsqueeze(-1)
        next_tensordict[STYLE_FEATURES] = next_tensordict["velocity"][..., SPEED : SPEED + 1].float()
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for key in (TASK_REWARD, STYLE_FEATURES):
            tensordict_reset[key] = torch.zeros(*tensordict_reset.batch_size, 1)
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key in (TASK_REWARD, STYLE_FEATURES):
            observation_spec[key] = Unbounded(shape=(*observation_spec.shape, 1))
        return observation_spec


def cheetah_env(num_envs: int = 16, seed: int = 0, seconds: float = 10.0) -> EnvBase:
    """Make cheetahs that are stepped one after the other in this process, with 25 steps per second.

    Args:
        num_envs: Number of cheetahs.
        seed: Seed of the initial states.
        seconds: Length of an episode [s].
    """
    logging.set_verbosity(logging.ERROR)  # each cheetah would print that a setting in the suite's file is deprecated
    cheetahs = SerialEnv(num_envs, lambda: DMControlEnv("cheetah", "run", frame_skip=4, time_limit=seconds))
    env = TransformedEnv(
        cheetahs,
        Compose(
            CheetahTask(),
            CatTensors(["position", "velocity"], "observation"),
            DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"]),
        ),
    )
    env.set_seed(seed)
    return env


def cheetah_events() -> PredicateEvents:
    """Return the events of the replay buffer: table "fast" holds the steps above 2.5 m/s."""
    return PredicateEvents({"fast": lambda steps: steps["next", STYLE_FEATURES][..., SPEED] > 2.5})


def build(config: dict[str, Any]) -> Trainer:
    """Make the training, one part after the other; recipe_boxes.py makes the parts that are alike in all recipes."""
    run = boxes.start_run(config)
    cfg = run.settings

    # Styles and their reward
    space = cheetah_space()
    space = space.with_sampler(cfg.sampler.build(space))
    style_reward = boxes.make_style_reward(run, cheetah_style_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        cheetah = cfg.env.build(seed=seed, **settings)
        env = CoachableEnv(cheetah, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
        env.set_seed(seed)
        return env

    example = make_env(cfg.seed, num_envs=1)  # shows the sizes of observations and actions

    # Actor, critics, their loss, and the learner that minimises it
    network = boxes.fitted_network(run, example)
    actor = network.actor.build(space=space).to(run.device)
    critics = [network.critic.build(space=space).to(run.device) for _ in range(network.num_critics)]
    loss = boxes.make_loss(run, actor, critics, example)
    if cfg.init_from:
        initialise_from(cfg.init_from, actor, loss, space, cfg.init_new_observations)
    learner = cfg.learner.build(loss)
    accelerate(learner, cfg.fast)  # same results up to rounding

    # Replay buffer, which sums rewards over n steps; its samples are relabelled with other styles
    replay = boxes.make_replay(run, example)
    if cfg.impersonation.n:
        tables = boxes.styles_of_tables(run, space, replay)
        relabel = TaskImpersonation(style_reward, n=cfg.impersonation.n, seed=cfg.seed, tables=tables)
        replay.append_transform(relabel)
    boxes.open_run_dir(run, example, replay)  # files are written from here on

    # Collector, evaluation and the training loop, which continues where a resumed run stopped
    collector = boxes.make_collector(run, make_env, actor)
    evaluate = boxes.make_evaluation(run, make_env, actor)
    return boxes.make_trainer(run, example, style_reward, actor, learner, replay, collector, evaluate)


if __name__ == "__main__":
    run_recipe("cheetah_speed", build)
