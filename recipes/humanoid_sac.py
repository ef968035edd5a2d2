"""Train the DMC humanoid to walk with a requested arm pose and step length (SAC; on a CPU QR-SAC).

python recipes/humanoid_sac.py                            on a CPU or a GPU
python recipes/humanoid_sac.py preset=smoke               every part once, within a minute
python recipes/humanoid_sac.py preset=paper               the paper's settings
python recipes/humanoid_sac.py family=gait                walking speed as a third parameter of the style
python recipes/humanoid_sac.py loss=sac                   another loss; see --help for all groups
python recipes/humanoid_sac.py train.batch_size=512 seed=1 run_dir=runs/mine
python recipes/humanoid_sac.py resume=runs/mine           continue where it stopped
python recipes/humanoid_sac.py init_from=runs/mine        new training from its actor and critics
"""

from typing import Any

import recipe_boxes as boxes
from recipe_config import run_recipe
from torchrl.envs import Compose, EnvBase

from coachable.domains.humanoid import humanoid_style_reward
from coachable.domains.humanoid.families import humanoid_family
from coachable.domains.humanoid.mirror_maps import humanoid_mirror_maps
from coachable.fast import accelerate
from coachable.training.episodes import EpisodeSums
from coachable.training.trainer import Trainer
from coachable.training.weights import initialise_from
from coachable.transforms import CoachableEnv, MirrorSymmetry, StyleRewardTransform, StyleSampler, TaskImpersonation


def build(config: dict[str, Any]) -> Trainer:
    """Make the training, one part after the other; recipe_boxes.py makes the parts that are alike in all recipes."""
    run = boxes.start_run({"family": "steps", **config})  # checkpoints of earlier versions name no family
    cfg = run.settings

    # Styles and their reward
    family = humanoid_family(cfg.family)
    space = family.make_space()
    space = space.with_sampler(cfg.sampler.build(space))
    style_reward = boxes.make_style_reward(run, humanoid_style_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        settings = {**family.options, **settings}
        humanoid = cfg.env.build(seed=seed, num_threads=run.simulator_threads, **settings)
        env = CoachableEnv(humanoid, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
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

    # Replay buffer, which sums rewards over n steps; its samples are mirrored, and relabelled with other styles
    replay = boxes.make_replay(run, example, mirrored=True)
    if cfg.mirror:
        replay.append_transform(MirrorSymmetry(humanoid_mirror_maps(family.styled_speed), cfg.mirror, seed=cfg.seed))
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
    run_recipe("humanoid_sac", build)
