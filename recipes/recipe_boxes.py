"""Parts of a training that all recipes share; recipes/humanoid_sac.py shows how they are combined."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from inspect import Parameter, isclass, signature
from pathlib import Path
from typing import Any

import torch
from configs.schema import Settings
from hydra.utils import instantiate
from recipe_checks import choices, typed_settings
from recipe_config import save_config
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase, Transform
from torchrl.objectives import LossModule

from coachable.domain import domain_names, load_domain
from coachable.keys import STYLE_FEATURES
from coachable.replay import EventTableBuffer
from coachable.replay.replay_files import replay_bytes
from coachable.styles import StyleReward, StyleSpace
from coachable.training.async_collector import AsyncCollector
from coachable.training.checkpoint import CheckpointStore, check_unused, check_writable
from coachable.training.collection import evaluate_policy, simulation_env
from coachable.training.hardware import pick_device, share_threads
from coachable.training.learner import Learner
from coachable.training.logging import MetricsLog, Progress, wandb_logger
from coachable.training.rng import seed_everything
from coachable.training.trainer import Trainer, replay_keys
from coachable.training.weights import agent_state
from coachable.transforms import MirrorSymmetry


@dataclass(frozen=True)
class Run:
    """One training: its configuration, and the resources of this machine that it uses.

    Attributes:
        config: The configuration as plain containers, as it is saved in checkpoints.
        settings: The same, typed.
        device: Device of the networks.
        simulator_threads: Threads of one simulator.
        learner_threads: Threads of the learner.
    """

    config: dict[str, Any]
    settings: Settings
    device: torch.device
    simulator_threads: int
    learner_threads: int


def start_run(config: dict[str, Any]) -> Run:
    """Check the settings, share the cores among simulator and learner, and seed all generators.

    Args:
        config: From `compose_config`.

    Raises:
        ValueError: If settings are of a wrong type or contradict each other.
    """
    settings = typed_settings(config)
    if "events" in settings.replay and settings.replay["events"] is None:
        raise ValueError(f"replay=event_tables: {settings.domain} names no events; expected replay=uniform")
    threads = share_threads(**config["threads"])
    # Rounding depends on the learner's number of threads, so that a resumed training has to use the same number.
    config = {**config, "threads": {**config["threads"], "learner": threads.learner}}
    torch.set_num_threads(threads.learner)
    seed_everything(settings.seed)
    device = pick_device(settings.device)
    per_simulator = max(1, threads.simulator // settings.collector["num_collectors"])
    if "cpus_per_worker" in settings.collector:  # of machines that may be others than this one
        per_simulator = max(1, int(settings.collector["cpus_per_worker"]))
    return Run(config, typed_settings(config), device, per_simulator, threads.learner)


def make(target: dict[str, Any]) -> Callable[..., Any]:
    """Return the function or class that `_target_` names, with the arguments that the YAML gives.

    Raises:
        ValueError: If it takes no such argument, or an argument is `true` or `false` and the value is not.
    """
    made = instantiate(target, _convert_="all", _partial_=True)
    known = _arguments_of(made.func)
    for name, value in made.keywords.items():
        if name not in known and not any(argument.kind is Parameter.VAR_KEYWORD for argument in known.values()):
            valid = [other for other in known if other not in ("self", "args", "space")]
            raise ValueError(f"{target['_target_']} takes no {name!r}.{choices(name, valid)}")
        if name in known and known[name].annotation in (bool, "bool") and not isinstance(value, bool):
            raise ValueError(f"{name}={value} of {target['_target_']}: expected true or false")
    return made


def _arguments_of(function: Callable[..., Any]) -> dict[str, Parameter]:
    """Return the arguments of a function, and for a class or its factory also those passed on by `**options`."""
    kind = function if isclass(function) else getattr(function, "__self__", None)
    known = {} if isclass(function) else dict(signature(function).parameters)
    for base in kind.__mro__ if isclass(kind) else ():
        options = [name for name, argument in known.items() if argument.kind is Parameter.VAR_KEYWORD]
        if known and not options:
            break
        for name in options:
            del known[name]
        known = {**signature(base.__init__).parameters, **known}
    return known


def make_style_reward(run: Run, factory: Callable[..., StyleReward], space: StyleSpace) -> StyleReward:
    """Make the style reward of a space with the numbers of `style_reward`.

    Raises:
        ValueError: If there are unknown numbers, or relabelling cannot sum this reward over steps.
    """
    settings = run.settings
    known = set(signature(factory).parameters) - {"space"}
    if unknown := set(settings.style_reward) - known:
        expected = ", ".join(sorted(known)) or "none"
        raise ValueError(f"style_reward has {', '.join(sorted(unknown))}: {settings.domain} takes {expected}")
    style_reward = factory(space, **settings.style_reward)
    n = settings.impersonation.n
    if n and settings.n_steps > 1 and not style_reward.is_linear:
        raise ValueError(
            f"impersonation.n={n} with n_steps={settings.n_steps}: the style reward of {settings.domain} is not "
            "linear in its features, which cannot be summed over steps; expected n_steps=1 or impersonation.n=0"
        )
    return style_reward


def network_settings(run: Run, env: EnvBase) -> dict[str, dict[str, Any]]:
    """Return the arguments of actor and critic, with the widths of the environment's observations and actions."""
    network = run.settings.network
    widths = {"obs_dim": env.observation_spec["observation"].shape[-1]}
    filled = {"actor": {**network.actor, **widths}, "critic": {**network.critic, **widths}}
    for part in filled.values():
        if "heads" not in part:  # the heads of a mixed action define its width
            part["action_dim"] = env.action_spec.shape[-1]
    return filled


def make_loss(run: Run, actor: nn.Module, critics: list[nn.Module], env: EnvBase) -> LossModule:
    """Make the loss on the run's device.

    Args:
        run: The training.
        actor: Its policy.
        critics: A list, because a single critic would be re-initialised by the loss.
        env: Its action specification bounds the policy.

    Raises:
        ValueError: If the loss does not serve the actions.
    """
    settings = run.settings
    buttons = settings.network.actor.get("heads", {}).get("categorical")
    if settings.loss["_target_"].endswith(".SACLoss") and buttons:
        raise ValueError(f"loss=sac serves continuous actions only, {settings.domain} has buttons: expected cat_rac")
    loss = make(settings.loss)(actor, critics, action_spec=env.action_spec, num_qvalue_nets=len(critics))
    loss.make_value_estimator(gamma=settings.gamma)
    return loss.to(run.device)


def make_replay(run: Run, env: EnvBase, *transforms: Transform) -> ReplayBuffer:
    """Make the replay buffer, which sums rewards over `n_steps` and allocates memory at the first write.

    Args:
        run: The training.
        env: One environment; its `scenario_names` are the tables of `replay=multi_tables`, or else there is one table.
        *transforms: Transforms of sampled batches, such as `MirrorSymmetry` and `TaskImpersonation`.

    Raises:
        ValueError: If batches are too small for the tables, or the domain has no mirror images although the settings
            need them.
    """
    settings = run.settings
    if settings.mirror and not any(isinstance(transform, MirrorSymmetry) for transform in transforms):
        raise ValueError(f"mirror={settings.mirror}: {settings.domain} has no mirror images, expected mirror=0")
    relabelled_sums = settings.impersonation.n and settings.n_steps > 1
    options: dict[str, Any] = {"discounted_keys": [("next", STYLE_FEATURES)]} if relabelled_sums else {}
    if _has_scenario_tables(settings):
        options["scenarios"] = getattr(simulation_env(env), "scenario_names", ())
        if not options["scenarios"]:
            print(f"replay=multi_tables: {settings.domain} has no scenarios, so that there is one table")
    replay = make(settings.replay)(**options)
    tables = len(replay.names) if isinstance(replay, EventTableBuffer) else 0
    if settings.train.batch_size < tables:
        raise ValueError(
            f"train.batch_size={settings.train.batch_size}: every batch holds at least one transition of each of "
            f"the {tables} tables ({', '.join(replay.names)})"
        )
    for transform in transforms:
        replay.append_transform(transform)
    return replay


def make_collector(run: Run, make_env: Callable[..., EnvBase], actor: nn.Module) -> BaseCollector | AsyncCollector:
    """Make the collector of the group `collector`: in this process, in several processes, or on several hosts."""
    settings = run.settings
    return make(settings.collector)(
        make_env,
        actor,
        frames_per_batch=settings.env["num_envs"] * settings.collector["num_collectors"],
        init_random_frames=settings.init_random_frames,
        seed=settings.seed,
        policy_device=run.device,
    )


def make_evaluation(run: Run, make_env: Callable[..., EnvBase], actor: nn.Module) -> Callable[[], dict[str, float]]:
    """Return a function that evaluates the actor on the same starts and styles every time.

    The style is measured where the domain is registered.
    """
    settings = run.settings
    seed = settings.seed + 10_000
    env = make_env(seed, num_envs=settings.eval.num_envs)
    known = settings.domain in domain_names()
    measures = load_domain(settings.domain, run.config).measures if known else None

    def evaluate() -> dict[str, float]:
        env.set_seed(seed)
        return evaluate_policy(env, actor, max_steps=settings.eval.max_steps, measures=measures, device=run.device)

    return evaluate


def make_description(
    run: Run, space: StyleSpace, actor: TensorDictModuleBase, loss: LossModule, network: dict[str, dict[str, Any]]
) -> Callable[[], dict[str, Any]]:
    """Return a function that returns the agent's description for checkpoints; see `agent_state`."""
    return partial(
        agent_state,
        domain=run.settings.domain,
        space=space,
        actor=actor,
        loss_module=loss,
        network=network,
        config=run.config,
    )


def open_run_dir(run: Run, env: EnvBase, replay: ReplayBuffer) -> None:
    """Make the run's folder and write the configuration into it.

    Args:
        run: The training.
        env: One environment, from whose transitions the size of checkpoints is computed.
        replay: The replay buffer that is saved in checkpoints.

    Raises:
        CheckpointError: If the folder holds another run, cannot be written to, or its disk is too small.
    """
    settings = run.settings
    run_dir = Path(settings.run_dir)
    if not settings.resume or not Path(settings.resume).resolve().is_relative_to(run_dir.resolve()):
        check_unused(run_dir)
    check_writable(run_dir)
    if settings.checkpoint.replay:  # two at a time: the old one is removed when the new one is complete
        size = replay_bytes(env, stored_keys(run, env, replay), settings.replay_capacity)
        check_writable(run_dir, required_bytes=2 * size)
    save_config(run.config, run_dir)


def stored_keys(run: Run, env: EnvBase, replay: ReplayBuffer) -> tuple[NestedKey, ...]:
    """Return the entries of a transition that the replay buffer stores."""
    tables = isinstance(replay, EventTableBuffer)
    return replay_keys(env, tables=tables, scenarios=_has_scenario_tables(run.settings))


def _has_scenario_tables(settings: Settings) -> bool:
    return settings.replay["_target_"].endswith(".for_scenarios")


def make_trainer(
    run: Run,
    env: EnvBase,
    collector: BaseCollector | AsyncCollector,
    replay: ReplayBuffer,
    learner: Learner,
    evaluate: Callable[[], dict[str, float]],
    describe: Callable[[], dict[str, Any]],
    style_reward: StyleReward,
) -> Trainer:
    """Make the training loop with its log and its checkpoints; a resumed run continues where it stopped.

    Args:
        run: The training.
        env: One environment, which is closed here.
        collector: Collector of transitions.
        replay: Replay buffer that stores them.
        learner: Learner that is trained on them.
        evaluate: Function that returns metrics of the current actor.
        describe: Function that returns the agent's description for checkpoints.
        style_reward: Style reward, whose terms are logged as metrics.
    """
    settings, run_dir = run.settings, Path(run.settings.run_dir)
    trainer = Trainer(
        settings=settings.train,
        collector=collector,
        replay=replay,
        learner=learner,
        evaluate=evaluate,
        describe=describe,
        style_terms=style_reward.terms_of,
        log=MetricsLog(run_dir, wandb_logger(settings.domain, run_dir, **run.config["wandb"])),
        progress=Progress(settings.train.total_frames),
        checkpoints=CheckpointStore(run_dir / "checkpoints", **run.config["checkpoint"]),
        replay_keys=stored_keys(run, env, replay),
    )
    env.close()  # here and not at garbage collection, because closing a SerialEnv changes the number of threads
    torch.set_num_threads(run.learner_threads)
    if settings.resume:
        print(f"resumed {trainer.resume(settings.resume)} at {trainer.frames} env-steps")
    return trainer
