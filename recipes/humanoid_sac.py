"""Train the DMC humanoid to walk with a requested arm pose and step length (SAC).

python recipes/humanoid_sac.py                            cpu or gpu, whatever this machine has
python recipes/humanoid_sac.py preset=smoke               every part once, within a minute
python recipes/humanoid_sac.py preset=paper               the paper's settings
python recipes/humanoid_sac.py train.batch_size=512 seed=1 run_dir=runs/mine
python recipes/humanoid_sac.py resume=runs/mine           continue where it stopped
python recipes/humanoid_sac.py init_from=runs/mine        new training from its actor and critics
"""

from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from recipe_config import run_recipe, save_config

from coachable.envs.humanoid import humanoid_style_reward, humanoid_style_space
from coachable.envs.humanoid.symmetry import humanoid_mirror_maps
from coachable.training.checkpoint import CheckpointStore, check_writable
from coachable.training.collection import evaluate_policy
from coachable.training.episodes import EpisodeSums
from coachable.training.hardware import detect, estimate_update_seconds, pick_device, share_threads
from coachable.training.logging import MetricsLog, Progress, wandb_logger
from coachable.training.loop import REPLAY_KEYS, Train
from coachable.training.replay_files import replay_bytes
from coachable.training.rng import seed_everything
from coachable.training.weights import agent_state, initialise_from
from coachable.transforms import CoachableEnv, MirrorSymmetry, TaskImpersonation, coachable_env


def build(config: dict[str, Any]) -> Train:
    """Composes a training from its configuration: env, actor and critics, loss, learner, replay, collector, loop."""
    run_dir = Path(config["run_dir"])
    check_writable(run_dir)
    save_config(config, run_dir)
    make = partial(instantiate, _convert_="all", _partial_=True)
    threads = share_threads(**config["threads"])
    torch.set_num_threads(threads.learner)
    seed_everything(config["seed"])
    device = pick_device(config["device"])

    # Styles and environment
    space = humanoid_style_space()
    style_reward = humanoid_style_reward(space, **config["style_reward"])

    workers = config["collector"]["num_collectors"]

    def make_env(seed: int, **settings: Any) -> CoachableEnv:
        simulation = make(config["env"])(num_threads=max(1, threads.simulator // workers), seed=seed, **settings)
        return coachable_env(simulation, space, style_reward, EpisodeSums(), seed=seed)

    # Actor and critics; a list of critics, because a single one would be re-initialised by the loss
    probe = make_env(config["seed"], num_envs=1)
    sizes = {"obs_dim": probe.observation_spec["observation"].shape[-1], "action_dim": probe.action_spec.shape[-1]}
    network = {part: {**config["network"][part], **sizes} for part in ("actor", "critic")}
    actor = make(network["actor"])(space=space).to(device)
    critics = [make(network["critic"])(space=space).to(device) for _ in range(config["network"]["num_critics"])]

    # Loss and learner
    loss_module = make(config["loss"])(actor, critics, action_spec=probe.action_spec, num_qvalue_nets=len(critics))
    loss_module.make_value_estimator(gamma=config["gamma"])
    loss_module.to(device)
    if config["init_from"]:
        initialise_from(config["init_from"], actor, loss_module, space)
    learner = make(config["learner"])(loss_module)

    # Replay and collector
    replay = make(config["replay"])()
    if config["mirror"]:
        replay.append_transform(MirrorSymmetry(humanoid_mirror_maps(), config["mirror"], seed=config["seed"]))
    if config["impersonation"]["n"]:
        replay.append_transform(TaskImpersonation(style_reward, seed=config["seed"], **config["impersonation"]))
    if config["checkpoint"]["replay"]:  # two at a time: the old one is removed when the new one is complete
        check_writable(run_dir, required_bytes=2 * replay_bytes(probe, REPLAY_KEYS, config["replay_capacity"]))
    collector = make(config["collector"])(
        make_env,
        actor,
        frames_per_batch=config["env"]["num_envs"] * workers,
        init_random_frames=config["init_random_frames"],
        seed=config["seed"],
        policy_device=device,
    )

    # Evaluation, log, checkpoints
    eval_env = make_env(config["seed"] + 10_000, num_envs=config["eval"]["num_envs"])

    def evaluate() -> dict[str, float]:
        eval_env.set_seed(config["seed"] + 10_000)  # the same starts and styles every time
        return evaluate_policy(eval_env, actor, max_steps=config["eval"]["max_steps"], device=device)

    describe = partial(
        agent_state,
        domain=config["domain"],
        space=space,
        actor=actor,
        loss_module=loss_module,
        network=network,
        config=config,
    )
    train = Train(
        collector=collector,
        replay=replay,
        learner=learner,
        settings=make(config["train"])(),
        log=MetricsLog(run_dir, wandb_logger(config["domain"], run_dir, **config["wandb"])),
        progress=Progress(config["train"]["total_frames"]),
        checkpoints=CheckpointStore(run_dir / "checkpoints", **config["checkpoint"]),
        describe=describe,
        evaluate=evaluate,
        style_terms=style_reward.terms_of,
    )
    if config["resume"]:
        print(f"resumed {train.resume(config['resume'])} at {train.frames} env-steps")
    return train


def announce(config: dict[str, Any], train: Train) -> None:
    """Says what was chosen and about how long it will take."""
    parameters = sum(p.numel() for p in train.learner.loss_module.actor_network_params.parameters())
    bf16 = train.learner.precision == "bf16"
    seconds = estimate_update_seconds(parameters, config["train"]["batch_size"], bf16, pick_device(config["device"]))
    remaining = config["train"]["total_frames"] - train.frames
    updates = remaining * (config["train"]["utd_ratio"] or 0)
    hours = max(updates * seconds, remaining / (config["train"]["throttle"] or float("inf"))) / 3600
    print(f"Found {detect().describe()}: preset {config['preset']}, {train.learner.precision} updates")
    print(f"{remaining:,} env-steps to go, about {hours:.1f} h ({seconds * 1e3:.0f} ms per update)")
    print(f"Writing to {config['run_dir']}; Ctrl-C saves a checkpoint and stops")


def main(config: dict[str, Any]) -> None:
    """Trains."""
    train = build(config)
    announce(config, train)
    train.run()


if __name__ == "__main__":
    run_recipe("humanoid_sac", main)
