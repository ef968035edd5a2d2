"""Train a racing driver whose style is chosen at run time (QR-SAC).

python recipes/racing_qr_sac.py                                tyre and fuel saving, on a CPU or a GPU
python recipes/racing_qr_sac.py preset=resources               the same, then overtaking and defending in traffic
python recipes/racing_qr_sac.py preset=drift                   drifting on request
python recipes/racing_qr_sac.py preset=aggressiveness          margins to two agents and two rivals, in five stages
python recipes/racing_qr_sac.py preset=paper                   the paper's settings
python recipes/racing_qr_sac.py preset=smoke                   every part once, within a minute

A preset's stages are trained one after the other; `stage=NAME init_from=RUN` trains one of them.
"""

from typing import Any

import recipe_boxes as boxes
from recipe_config import run_recipe
from torchrl.envs import Compose, EnvBase

from coachable.domains.racing.families import racing_family
from coachable.domains.racing.mirror_maps import racing_mirror_maps
from coachable.fast import accelerate
from coachable.training.collection import simulation_env
from coachable.training.episodes import EpisodeSums
from coachable.training.trainer import Trainer
from coachable.training.weights import initialise_from
from coachable.transforms import CoachableEnv, MirrorSymmetry, StyleRewardTransform, StyleSampler, TaskImpersonation


def build(config: dict[str, Any]) -> Trainer:
    """Make the training, one part after the other; recipe_boxes.py makes the parts that are alike in all recipes."""
    run = boxes.start_run(config)
    cfg = run.settings

    # Styles and their reward
    family = racing_family(cfg.family)
    space = family.make_space()
    space = space.with_sampler(cfg.sampler.build(space))
    style_reward = boxes.make_style_reward(run, family.make_reward, space)

    # Environment: styles are drawn at reset, the reward is the sum of the task's and the style's
    def make_env(seed: int, **settings: Any) -> EnvBase:
        race = cfg.env.build(seed=seed, **settings)
        env = CoachableEnv(race, Compose(StyleSampler(space), StyleRewardTransform(style_reward), EpisodeSums()))
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
        replay.append_transform(MirrorSymmetry(racing_mirror_maps(simulation_env(example)), cfg.mirror, seed=cfg.seed))
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
    run_recipe("racing_qr_sac", build)
