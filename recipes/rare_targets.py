"""Reach the one of eight small targets that the style names, which needs event tables and task impersonation.

python recipes/rare_targets.py                            both on, a minute or two on one core
python recipes/rare_targets.py replay=uniform impersonation.n=0
python recipes/rare_targets.py preset=smoke

Random actions seldom lead to a target, and seldom to the right one. Event tables keep the transitions that lead to a
target; impersonation relabels them with the style that asks for this target.
"""

import math
from typing import Any

import recipe_boxes as boxes
import torch
from recipe_config import run_recipe
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded
from torchrl.envs import Compose, EnvBase

from coachable.fast import accelerate
from coachable.keys import EVENTS, STYLE_FEATURES, TASK_REWARD
from coachable.replay import KeyEvents
from coachable.specs import set_specs
from coachable.styles import StyleReward, StyleSpace, Weight, WeightedFeature
from coachable.styles.mixtures import style_mixture
from coachable.training.episodes import EpisodeSums
from coachable.training.trainer import Trainer
from coachable.training.weights import initialise_from
from coachable.transforms import CoachableEnv, StyleRewardTransform, StyleSampler, TaskImpersonation

TARGETS = 8
NAMES = tuple(f"target_{i}" for i in range(TARGETS))
RADIUS, DISTANCE = 0.08, 1.0  # of a target, and from the centre to it
SPEED = 0.06  # per step
STEPS = 60


class RareTargets(EnvBase):
    """Environment of N points in the plane, steered at bounded speed; an episode ends at any target.

    Args:
        num_envs: Number of points N.
        seed: Seed of the initial positions.
    """

    def __init__(self, num_envs: int = 64, seed: int = 0) -> None:
        super().__init__(batch_size=[num_envs])
        events = Binary(TARGETS, (num_envs, TARGETS), dtype=torch.bool)
        action = Bounded(-1.0, 1.0, (num_envs, 2))
        set_specs(self, action=action, observation=3, style_features=TARGETS, further={EVENTS: events})
        angles = torch.arange(TARGETS) * (2 * math.pi / TARGETS)
        self.targets = DISTANCE * torch.stack([angles.cos(), angles.sin()], -1)
        self.position = torch.zeros(num_envs, 2)
        self.age = torch.zeros(num_envs, 1)
        self.generator = torch.Generator()
        self._set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        again = torch.ones_like(self.age, dtype=torch.bool) if mask is None else mask.reshape(self.age.shape)
        start = 0.2 * torch.rand(self.position.shape, generator=self.generator) - 0.1
        self.position = torch.where(again, start, self.position)
        self.age = torch.where(again, 0.0, self.age)
        return self._package(torch.zeros(*self.batch_size, TARGETS, dtype=torch.bool))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.position = (self.position + SPEED * tensordict["action"]).clamp(-1.2, 1.2)
        self.age = self.age + 1
        reached = (self.position.unsqueeze(1) - self.targets).norm(dim=-1) < RADIUS
        return self._package(reached).set("reward", torch.zeros_like(self.age))

    def _package(self, reached: Tensor) -> TensorDictBase:
        terminated = reached.any(-1, keepdim=True)
        truncated = (self.age >= STEPS) & ~terminated
        return TensorDict(
            {
                "observation": torch.cat([self.position, self.age / STEPS], -1),
                TASK_REWARD: torch.zeros_like(self.age),
                STYLE_FEATURES: reached.float(),
                EVENTS: reached,
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
            batch_size=self.batch_size,
        )

    def simulator_state(self) -> dict[str, Any]:
        """Return the state that the next step depends on, so that a training can be resumed exactly."""
        return {"position": self.position.clone(), "age": self.age.clone(), "generator": self.generator.get_state()}

    def load_simulator_state(self, state: dict[str, Any]) -> None:
        """Restore the output of `simulator_state`."""
        self.position, self.age = state["position"].clone(), state["age"].clone()
        self.generator.set_state(state["generator"])


def target_space() -> StyleSpace:
    """Return the style space: a weight per target, of which mostly one at a time is drawn."""
    space = StyleSpace([Weight(name, 0.0, 1.0, help="worth of this target") for name in NAMES], name="targets")
    return space.with_sampler(style_mixture(space))


def target_reward(space: StyleSpace, *, scale: float = 10.0) -> StyleReward:
    """Return a style reward of `scale` times the weight of the target that is reached."""
    terms = {name: WeightedFeature(name, i) for i, name in enumerate(NAMES)}
    return StyleReward(space, terms, scales=dict.fromkeys(terms, scale))


def target_events() -> KeyEvents:
    """Return the events of the replay buffer: one table per target."""
    return KeyEvents(NAMES)


def build(config: dict[str, Any]) -> Trainer:
    """Make the training, one part after the other; recipe_boxes.py makes the parts that are alike in all recipes."""
    run = boxes.start_run(config)
    cfg = run.settings

    # Styles and their reward
    space = target_space()
    space = space.with_sampler(cfg.sampler.build(space))
    style_reward = boxes.make_style_reward(run, target_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        targets = cfg.env.build(seed=seed, **settings)
        env = CoachableEnv(targets, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
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
    run_recipe("rare_targets", build)
