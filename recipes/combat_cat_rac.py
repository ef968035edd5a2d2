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
    """Make the training from its parts, see recipe_boxes.py."""
    run = boxes.start_run(config)
    cfg = run.settings

    # Styles and their reward
    space = combat_style_space(cfg.env["styles"], cfg.env["reward_scale"])
    space = space.with_sampler(boxes.make(cfg.sampler)(space))
    style_reward = boxes.make_style_reward(run, combat_style_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        fight = boxes.make(cfg.env)(seed=seed, **settings)
        env = CoachableEnv(fight, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
        env.set_seed(seed)
        return env

    example = make_env(cfg.seed, num_envs=1)

    # Actor, critics and loss
    network = boxes.network_settings(run, example)
    actor = boxes.make(network["actor"])(space=space).to(run.device)
    critics = [boxes.make(network["critic"])(space=space).to(run.device) for _ in range(cfg.network.num_critics)]
    loss = boxes.make_loss(run, actor, critics, example)
    if cfg.init_from:
        initialise_from(cfg.init_from, actor, loss, space, cfg.init_new_observations)
    learner = boxes.make(run.config["learner"])(loss)
    accelerate(learner, cfg.fast)

    # Replay buffer: sums over n steps, and relabelling with other styles
    relabelled = []
    if cfg.impersonation.n:
        relabelled.append(TaskImpersonation(style_reward, n=cfg.impersonation.n, seed=cfg.seed))
    replay = boxes.make_replay(run, example, *relabelled)
    boxes.open_run_dir(run, example, replay)

    # Collector, evaluation and training loop
    collector = boxes.make_collector(run, make_env, actor)
    evaluate = boxes.make_evaluation(run, partial(make_env, components=True), actor)  # which the measured style needs
    describe = boxes.make_description(run, space, actor, loss, network)
    return boxes.make_trainer(run, example, collector, replay, learner, evaluate, describe, style_reward)


if __name__ == "__main__":
    run_recipe("combat_cat_rac", build)
