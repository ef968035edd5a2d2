"""From a configuration to a training: the composition that the recipes share."""

from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from recipe_config import save_config
from tensordict import NestedKey

from coachable.fast import accelerate
from coachable.keys import STYLE_FEATURES
from coachable.replay import EventTableBuffer
from coachable.replay.replay_files import replay_bytes
from coachable.styles import StyleReward, StyleSpace
from coachable.training.checkpoint import CheckpointStore, check_unused, check_writable
from coachable.training.collection import evaluate_policy
from coachable.training.episodes import EpisodeSums
from coachable.training.hardware import pick_device, share_threads
from coachable.training.logging import MetricsLog, Progress, wandb_logger
from coachable.training.loop import Train, replay_keys
from coachable.training.rng import seed_everything
from coachable.training.weights import agent_state, initialise_from
from coachable.transforms import CoachableEnv, MirrorMap, MirrorSymmetry, TaskImpersonation, coachable_env


def build_training(
    config: dict[str, Any],
    space: StyleSpace,
    make_style_reward: Callable[..., StyleReward],
    mirror_maps: Mapping[NestedKey, MirrorMap] | None = None,
) -> Train:
    """Composes a training: env, actor and critics, loss, learner, replay, collector, evaluation, loop.

    Args:
        config: as composed from recipes/configs; `config["env"]` names the simulation, without styles.
        space: the styles to train on.
        make_style_reward: `(space, **config["style_reward"]) -> StyleReward`.
        mirror_maps: how transitions are mirrored, for `config["mirror"]`.
    """
    make = partial(instantiate, _convert_="all", _partial_=True)

    # Settings and styles: what contradicts itself is refused before anything is written or allocated
    train_settings = make(config["train"])()
    space = space.with_sampler(make(config["sampler"])(space))
    known = set(signature(make_style_reward).parameters) - {"space"}
    if unknown := set(config["style_reward"]) - known:
        expected = ", ".join(sorted(known)) or "none"
        raise ValueError(f"style_reward has {', '.join(sorted(unknown))}: {config['domain']} takes {expected}")
    style_reward = make_style_reward(space, **config["style_reward"])
    check_relabelling(config, style_reward)

    # Environment
    threads = share_threads(**config["threads"])
    # The learner's sums are rounded as their number of threads says: a resumed training takes as many.
    config = {**config, "threads": {**config["threads"], "learner": threads.learner}}
    torch.set_num_threads(threads.learner)
    seed_everything(config["seed"])
    device = pick_device(config["device"])
    workers = config["collector"]["num_collectors"]

    def make_env(seed: int, **settings: Any) -> CoachableEnv:
        simulation = make(config["env"])
        if "num_threads" in signature(simulation).parameters:
            settings["num_threads"] = max(1, threads.simulator // workers)
        return coachable_env(simulation(seed=seed, **settings), space, style_reward, EpisodeSums(), seed=seed)

    probe = make_env(config["seed"], num_envs=1)

    # Replay, which takes memory when it is first written to
    relabelled_sums = config["impersonation"]["n"] and config["n_steps"] > 1
    replay = make(config["replay"])(**({"discounted_keys": [("next", STYLE_FEATURES)]} if relabelled_sums else {}))
    tables = len(replay.names) if isinstance(replay, EventTableBuffer) else 0
    if config["train"]["batch_size"] < tables:
        raise ValueError(
            f"train.batch_size={config['train']['batch_size']}: every batch holds at least one transition of each of "
            f"the {tables} tables ({', '.join(replay.names)})"
        )
    if config["mirror"]:
        if mirror_maps is None:
            raise ValueError(f"mirror={config['mirror']}: {config['domain']} has no mirror images, expected mirror=0")
        replay.append_transform(MirrorSymmetry(mirror_maps, config["mirror"], seed=config["seed"]))
    if config["impersonation"]["n"]:
        replay.append_transform(TaskImpersonation(style_reward, seed=config["seed"], **config["impersonation"]))
    keys = replay_keys(probe, tables=bool(tables))
    run_dir = Path(config["run_dir"])
    if not config["resume"] or not Path(config["resume"]).resolve().is_relative_to(run_dir.resolve()):
        check_unused(run_dir)
    check_writable(run_dir)
    if config["checkpoint"]["replay"]:  # two at a time: the old one is removed when the new one is complete
        check_writable(run_dir, required_bytes=2 * replay_bytes(probe, keys, config["replay_capacity"]))
    save_config(config, run_dir)

    # Actor and critics; a list of critics, because a single one would be re-initialised by the loss
    obs_dim, action_dim = probe.observation_spec["observation"].shape[-1], probe.action_spec.shape[-1]
    network = {part: {**config["network"][part], "obs_dim": obs_dim} for part in ("actor", "critic")}
    for part in network.values():
        if "heads" not in part:  # of a mixed action; they say how wide it is
            part["action_dim"] = action_dim
    actor = make(network["actor"])(space=space).to(device)
    critics = [make(network["critic"])(space=space).to(device) for _ in range(config["network"]["num_critics"])]

    # Loss and learner
    if config["loss"]["_target_"].endswith(".SACLoss") and network["actor"].get("heads", {}).get("categorical"):
        raise ValueError(f"loss=sac serves continuous actions only, {config['domain']} has buttons: expected cat_rac")
    loss_module = make(config["loss"])(actor, critics, action_spec=probe.action_spec, num_qvalue_nets=len(critics))
    loss_module.make_value_estimator(gamma=config["gamma"])
    loss_module.to(device)
    probe.close()  # now, not whenever it is collected: TorchRL raises the number of threads when it closes a SerialEnv
    torch.set_num_threads(threads.learner)
    if config["init_from"]:
        initialise_from(config["init_from"], actor, loss_module, space, config["init_new_observations"])
    learner = make(config["learner"])(loss_module)
    accelerate(learner, config.get("fast", "auto"))  # runs that were saved before this setting existed have none

    # Collector
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
        settings=train_settings,
        log=MetricsLog(run_dir, wandb_logger(config["domain"], run_dir, **config["wandb"])),
        progress=Progress(config["train"]["total_frames"]),
        checkpoints=CheckpointStore(run_dir / "checkpoints", **config["checkpoint"]),
        describe=describe,
        evaluate=evaluate,
        style_terms=style_reward.terms_of,
        replay_keys=keys,
    )
    if config["resume"]:
        print(f"resumed {train.resume(config['resume'])} at {train.frames} env-steps")
    return train


def check_relabelling(config: dict[str, Any], style_reward: StyleReward) -> None:
    """Refuses replay settings that contradict each other.

    Raises:
        ValueError: naming the settings that contradict each other.
    """
    replay, n = config["replay"], config["impersonation"]["n"]
    if "events" in replay and replay["events"] is None:
        raise ValueError(f"replay=event_tables: {config['domain']} names no events; expected replay=uniform")
    if n and config["n_steps"] > 1 and not style_reward.is_linear:
        raise ValueError(
            f"impersonation.n={n} with n_steps={config['n_steps']}: the style reward of {config['domain']} is not "
            "linear in its features, which cannot be summed over steps; expected n_steps=1 or impersonation.n=0"
        )
