"""Parts of a training that are alike in all recipes; each function makes one part for a recipe's composition."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from inspect import signature
from itertools import product
from pathlib import Path
from typing import Any

import torch
from configs.schema import Network, Settings
from recipe_checks import typed_settings
from recipe_target import Target
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from coachable.distributions.action_heads import MixedActionSpec
from coachable.domain import domain_names, load_domain
from coachable.keys import STYLE_FEATURES
from coachable.losses.actor_critic import ActorCriticLoss
from coachable.replay import EventTableBuffer
from coachable.replay.replay_files import replay_bytes
from coachable.styles import Sampler, StyleReward, StyleSpace
from coachable.styles.mixtures import single_weight
from coachable.training.async_collector import AsyncCollector
from coachable.training.checkpoint import CheckpointStore, check_unused, check_writable, claim_folder
from coachable.training.collection import evaluate_policy, require_same_bounds, simulation_env
from coachable.training.hardware import pick_device, share_threads
from coachable.training.learner import Learner
from coachable.training.logging import MetricsLog, Progress, wandb_logger
from coachable.training.rng import seed_everything
from coachable.training.trainer import Trainer, replay_keys
from coachable.training.weights import agent_state


@dataclass(frozen=True)
class Run:
    """One training: its configuration, and the resources of this machine that it uses.

    Attributes:
        config: The configuration as plain containers, as it is saved in checkpoints.
        settings: The same, typed; `FamilySettings` in recipes with families of styles.
        device: Device of the networks.
        simulator_threads: Threads of one simulator.
    """

    config: dict[str, Any]
    settings: Settings
    device: torch.device
    simulator_threads: int


def start_run(config: dict[str, Any]) -> Run:
    """Check the settings, share the cores among simulator and learner, and seed all generators.

    Args:
        config: From `compose_config`.

    Raises:
        ValueError: If settings are of a wrong type or contradict each other.
    """
    settings = typed_settings(config)
    if settings.replay.get("events", {}) is None:
        raise ValueError(f"replay=event_tables: {settings.domain} names no events; expected replay=uniform")
    if settings.init_new_observations and not (settings.init_from or settings.resume):
        raise ValueError(f"init_new_observations={settings.init_new_observations}: expected init_from=PATH beside it")
    threads = share_threads(settings.threads.simulator, settings.threads.learner)
    # Rounding depends on the learner's number of threads, so that a resumed training has to use the same number.
    settings.threads.learner = threads.learner
    torch.set_num_threads(threads.learner)
    seed_everything(settings.seed)
    per_simulator = max(1, threads.simulator // settings.collector.num_collectors)
    if "cpus_per_worker" in settings.collector:  # of machines that may be others than this one
        per_simulator = max(1, int(settings.collector.cpus_per_worker))
    config = {**config, "threads": asdict(settings.threads)}
    return Run(config, settings, pick_device(settings.device), per_simulator)


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
    if settings.impersonation.own_table and not n:
        raise ValueError(
            "impersonation.own_table=true with impersonation.n=0, which has no further label: expected n >= 1"
        )
    if n and settings.n_steps > 1 and not style_reward.is_linear:
        raise ValueError(
            f"impersonation.n={n} with n_steps={settings.n_steps}: the style reward of {settings.domain} is not "
            "linear in its features, which cannot be summed over steps; expected n_steps=1 or impersonation.n=0"
        )
    return style_reward


def fitted_network(run: Run, env: EnvBase) -> Network:
    """Return the settings of actor and critics, with the widths of the environment's observations and actions.

    Raises:
        ValueError: If the configuration gives a width itself.
    """
    network = run.settings.network
    widths = {"obs_dim": env.observation_spec["observation"].shape[-1], "action_dim": env.action_spec.shape[-1]}
    for part, name in product(("actor", "critic"), widths):
        if name in getattr(network, part):
            raise ValueError(f"network.{part}.{name}: the environment sets it, expected no {name} here")
    actor, critic = Target(network.actor, **widths), Target(network.critic, **widths)
    if "heads" in actor:  # they define the width of a mixed action
        del actor["action_dim"]
    return replace(network, actor=actor, critic=critic)


def make_loss(run: Run, actor: nn.Module, critics: list[nn.Module], env: EnvBase) -> LossModule:
    """Make the loss on the run's device.

    Args:
        run: The training.
        actor: Its policy.
        critics: A list, because a single critic would be re-initialised by the loss.
        env: Its action specification bounds the policy.

    Raises:
        ValueError: If the loss does not serve the actions or the actor has other bounds, or if the loss needs more
            critics or other outputs of them.
    """
    settings = run.settings
    is_sac = settings.loss._target_.endswith(".SACLoss")
    if is_sac and len(critics) < 2:
        raise ValueError(f"network.num_critics is {len(critics)}: expected at least 2 with loss=sac")
    if is_sac and settings.network.actor.get("heads", {}).get("categorical"):
        raise ValueError("loss=sac serves continuous actions only, network.actor has buttons: expected cat_rac")
    if is_sac and isinstance(env.action_spec, MixedActionSpec):  # it would take the one-hots for axes
        raise ValueError(
            f"loss=sac serves continuous actions only, {settings.domain} has buttons: expected cat_rac, network=gamepad"
        )
    require_same_bounds(env, actor)
    loss = settings.loss.build(actor, critics, action_spec=env.action_spec, num_qvalue_nets=len(critics))
    if is_sac or isinstance(loss, ActorCriticLoss):
        with torch.no_grad(), torch.random.fork_rng(devices=[]):  # critics may have dropout
            outputs = critics[0](env.fake_tensordict().to(run.device))["state_action_value"].shape[-1]
        expected = 1 if is_sac else loss.critic_outputs()
        if outputs != expected:
            raise ValueError(
                f"network.critic makes critics with {outputs} outputs: {type(loss).__name__} expects {expected}"
            )
    for name in {"v_min", "v_max"} & set(settings.network.critic) & set(settings.loss):
        if settings.network.critic[name] != settings.loss[name]:
            raise ValueError(
                f"network.critic.{name}={settings.network.critic[name]}: the loss has {settings.loss[name]}; expected "
                "critic_support to set both"
            )
    loss.make_value_estimator(gamma=settings.gamma)
    return loss.to(run.device)


def make_replay(run: Run, env: EnvBase, *, mirrored: bool = False) -> ReplayBuffer:
    """Make the replay buffer, which sums rewards over `n_steps` and allocates memory at the first write.

    Args:
        run: The training.
        env: One environment; its `scenario_names` are the tables of `replay=multi_tables`, or else there is one table.
        mirrored: Whether the domain has mirror images, as `mirror` needs them.

    Raises:
        ValueError: If batches are too small for the tables, or the domain has no mirror images although the settings
            need them.
    """
    settings = run.settings
    if settings.mirror and not mirrored:
        raise ValueError(f"mirror={settings.mirror}: {settings.domain} has no mirror images, expected mirror=0")
    relabelled_sums = settings.impersonation.n and settings.n_steps > 1
    options: dict[str, Any] = {"discounted_keys": [("next", STYLE_FEATURES)]} if relabelled_sums else {}
    if _has_scenario_tables(settings):
        options["scenarios"] = getattr(simulation_env(env), "scenario_names", ())
        if not options["scenarios"]:
            print(f"replay=multi_tables: {settings.domain} has no scenarios, so that there is one table")
    replay = settings.replay.build(**options)
    tables = len(replay.names) if isinstance(replay, EventTableBuffer) else 0
    if settings.train.batch_size < tables:
        raise ValueError(
            f"train.batch_size={settings.train.batch_size}: every batch holds at least one transition of each of "
            f"the {tables} tables ({', '.join(replay.names)})"
        )
    return replay


def styles_of_tables(run: Run, space: StyleSpace, replay: ReplayBuffer) -> dict[int, Sampler]:
    """Return a sampler of styles that ask for a table's event, by the number of the table, for `TaskImpersonation`.

    There are none without `impersonation.own_table`.

    Raises:
        ValueError: If `impersonation.own_table` is set and no table has the name of a weight.
    """
    if not run.settings.impersonation.own_table:
        return {}
    names = replay.names if isinstance(replay, EventTableBuffer) else ()
    tables = {number: single_weight(space, name) for number, name in enumerate(names) if name in space.names}
    if not tables:
        raise ValueError(
            "impersonation.own_table=true: expected replay=event_tables with a table for each weight of "
            f"{run.settings.domain}; the tables are {', '.join(names) or 'none'}"
        )
    return tables


def make_collector(run: Run, make_env: Callable[..., EnvBase], actor: nn.Module) -> BaseCollector | AsyncCollector:
    """Make the collector of the group `collector`: in this process, in several processes, or on several hosts."""
    settings = run.settings
    return settings.collector.build(
        make_env,
        actor,
        frames_per_batch=settings.env.num_envs * settings.collector.num_collectors,
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


def open_run_dir(run: Run, env: EnvBase, replay: ReplayBuffer) -> None:
    """Make the run's folder, and check that the run can be written into it.

    Args:
        run: The training.
        env: One environment, from whose transitions the size of checkpoints is computed.
        replay: The replay buffer that is saved in checkpoints.

    Raises:
        CheckpointError: If the folder holds another run, another process writes to it, it cannot be written to, or its
            disk is too small.
    """
    settings = run.settings
    run_dir = Path(settings.run_dir)
    if not settings.resume or not Path(settings.resume).resolve().is_relative_to(run_dir.resolve()):
        check_unused(run_dir)
    check_writable(run_dir)
    claim_folder(run_dir)
    check_writable(run_dir / "checkpoints")
    if settings.checkpoint.replay:  # two at a time: the old one is removed when the new one is complete
        size = replay_bytes(replay, env, stored_keys(run, env, replay))
        kept = sum(file.stat().st_size for file in run_dir.glob("checkpoints/*/replay/*"))
        check_writable(run_dir, required_bytes=max(0, 2 * size - kept))


def stored_keys(run: Run, env: EnvBase, replay: ReplayBuffer) -> tuple[NestedKey, ...]:
    """Return the entries of a transition that the replay buffer stores."""
    scenarios = _has_scenario_tables(run.settings)
    return replay_keys(env, tables=isinstance(replay, EventTableBuffer), scenarios=scenarios)


def _has_scenario_tables(settings: Settings) -> bool:
    return settings.replay._target_.endswith(".for_scenarios")


def make_trainer(
    run: Run,
    env: EnvBase,
    style_reward: StyleReward,
    actor: TensorDictModuleBase,
    learner: Learner,
    replay: ReplayBuffer,
    collector: BaseCollector | AsyncCollector,
    evaluate: Callable[[], dict[str, float]],
) -> Trainer:
    """Make the training loop, with its log and its checkpoints in the run's folder; resume the run of `resume`.

    The configuration is written into the folder at the end, so that a refused resumption leaves that of the run.

    Args:
        run: The training.
        env: One environment, whose specification shows which entries are stored. It is closed.
        style_reward: Style reward, whose terms are logged as metrics.
        actor: Policy, which checkpoints describe.
        learner: Learner that trains it.
        replay: Replay buffer that stores transitions.
        collector: Collector of transitions.
        evaluate: Function that returns metrics of the current actor.

    Raises:
        CheckpointError: If the run of `resume` is damaged or does not fit.
    """
    settings, run_dir = run.settings, Path(run.settings.run_dir)
    network = fitted_network(run, env)
    name = f"{settings.domain} {settings.stage}" if settings.stage else settings.domain
    trainer = Trainer(
        settings=settings.train,
        collector=collector,
        replay=replay,
        learner=learner,
        evaluate=evaluate,
        describe=partial(
            agent_state,
            domain=settings.domain,
            space=style_reward.space,
            actor=actor,
            loss_module=learner.loss_module,
            network={"actor": dict(network.actor), "critic": dict(network.critic)},
            config=run.config,
        ),
        style_terms=style_reward.terms_of,
        log=MetricsLog(run_dir, wandb_logger(name, run_dir, **asdict(settings.wandb))),
        progress=Progress(settings.train.total_frames),
        checkpoints=CheckpointStore(run_dir / "checkpoints", **asdict(settings.checkpoint)),
        replay_keys=stored_keys(run, env, replay),
    )
    # TorchRL changes the number of threads when a `SerialEnv` is closed, which must not be left to garbage collection.
    env.close()
    torch.set_num_threads(settings.threads.learner)
    if settings.resume:
        trainer.resume(settings.resume)
    (run_dir / "config.json").write_text(json.dumps(run.config, indent=1) + "\n", encoding="utf-8")
    return trainer
