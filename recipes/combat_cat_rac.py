"""Train a fighter with a gamepad whose way of fighting is chosen at run time (Cat-RAC, impersonation, event tables).

python recipes/combat_cat_rac.py                          small on a CPU, full on a GPU
python recipes/combat_cat_rac.py preset=middle            more machines and styles
python recipes/combat_cat_rac.py preset=smoke             every part once, within a minute

The ablations of Appendix D:
python recipes/combat_cat_rac.py loss=sac_categorical
python recipes/combat_cat_rac.py impersonation.n=0
python recipes/combat_cat_rac.py sampler=independent      or one_hot
"""

from functools import partial
from typing import Any

import recipe_boxes as boxes
from recipe_config import run_recipe
from torchrl.envs import Compose, EnvBase

from coachable.domains.combat import combat_style_reward, combat_style_space
from coachable.fast import accelerate
from coachable.training.episodes import EpisodeSums
from coachable.training.trainer import Trainer
from coachable.training.weights import initialise_from
from coachable.transforms import CoachableEnv, StyleRewardTransform, StyleSampler, TaskImpersonation


def build(config: dict[str, Any]) -> Trainer:
    """Make the training, one part after the other; recipe_boxes.py makes the parts that are alike in all recipes."""
    run = boxes.start_run(config)
    cfg = run.settings

    # Styles and their reward
    space = combat_style_space(cfg.env.styles, cfg.env.reward_scale)
    space = space.with_sampler(cfg.sampler.build(space))
    style_reward = boxes.make_style_reward(run, combat_style_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        fight = cfg.env.build(seed=seed, **settings)
        env = CoachableEnv(fight, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
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
    evaluate = boxes.make_evaluation(run, partial(make_env, components=True), actor)  # from which the style is measured
    return boxes.make_trainer(run, example, style_reward, actor, learner, replay, collector, evaluate)


if __name__ == "__main__":
    run_recipe("combat_cat_rac", build)
