"""Train the DMC humanoid to walk with a requested arm pose and step length (SAC).

python recipes/humanoid_sac.py                            on a CPU or a GPU
python recipes/humanoid_sac.py preset=smoke               every part once, within a minute
python recipes/humanoid_sac.py preset=paper               the paper's settings
python recipes/humanoid_sac.py family=gait                walking speed as a third style
python recipes/humanoid_sac.py loss=qr_sac                another loss; see --help for all groups
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
    """Make the training from its parts, see recipe_boxes.py."""
    run = boxes.start_run(config)
    cfg = run.settings

    # Styles and their reward
    family = humanoid_family(config.get("family", "steps"))  # checkpoints of earlier versions name no family
    space = family.make_space()
    space = space.with_sampler(boxes.make(cfg.sampler)(space))
    style_reward = boxes.make_style_reward(run, humanoid_style_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        settings = {**family.options, **settings}
        humanoid = boxes.make(cfg.env)(seed=seed, num_threads=run.simulator_threads, **settings)
        env = CoachableEnv(humanoid, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
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

    # Replay buffer: sums over n steps, mirror images, and relabelling with other styles
    relabelled = []
    if cfg.mirror:
        relabelled.append(MirrorSymmetry(humanoid_mirror_maps(family.styled_speed), cfg.mirror, seed=cfg.seed))
    if cfg.impersonation.n:
        relabelled.append(TaskImpersonation(style_reward, n=cfg.impersonation.n, seed=cfg.seed))
    replay = boxes.make_replay(run, example, *relabelled)
    boxes.open_run_dir(run, example, replay)

    # Collector, evaluation and training loop
    collector = boxes.make_collector(run, make_env, actor)
    evaluate = boxes.make_evaluation(run, make_env, actor)
    describe = boxes.make_description(run, space, actor, loss, network)
    return boxes.make_trainer(run, example, collector, replay, learner, evaluate, describe, style_reward)


if __name__ == "__main__":
    run_recipe("humanoid_sac", build)
