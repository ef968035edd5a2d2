"""Collecting: TorchRL's collector with a state that a training can be resumed from, and a short evaluation."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType

from coachable.training.rng import preserved_rng
from coachable.training.simulators import ResumableEnv, UnsavableError, load_simulator, save_simulator

__all__ = [
    "ResumableEnv",
    "SelfPlayEnv",
    "collector_state",
    "evaluate_policy",
    "load_collector_state",
    "make_collector",
    "simulation_env",
]


@runtime_checkable
class SelfPlayEnv(Protocol):
    """An env in which the agent meets its own past."""

    def follow(self, policy: nn.Module) -> None:
        """The policy to take copies of."""
        ...


def make_collector(
    make_env: Callable[[int], EnvBase],
    policy: Any,
    *,
    frames_per_batch: int,
    init_random_frames: int = 0,
    backend: str = "direct",
    num_collectors: int = 1,
    sync: bool = True,
    seed: int = 0,
    policy_device: torch.device | str | None = None,
) -> BaseCollector:
    """Makes the collector of a training.

    Args:
        make_env: called with a seed, returns a batched env `[N]` that is already seeded (the collector's constructor
            resets it, so seeding afterwards would miss the first episode).
        policy: the actor; with `backend="direct"` it is used as it is, so updates reach it without a copy.
        frames_per_batch: env-steps per iteration, a multiple of N.
        init_random_frames: env-steps with uniformly random actions at the start.
        backend: "direct" (this process), "process" (one host) or "ray" (many hosts).
        num_collectors: workers of the latter two.
        sync: whether an iteration waits for all workers.
        seed: worker i gets `seed + i`.
        policy_device: where the policy runs, if not where the env is.

    Raises:
        ValueError: for an unknown backend.
        ImportError: for Ray, where it is not installed.
    """
    common: dict[str, Any] = {
        "frames_per_batch": frames_per_batch,
        "total_frames": -1,  # the loop decides when to stop
        # rounded up to whole iterations, which TorchRL does too, but with a warning
        "init_random_frames": -(-init_random_frames // frames_per_batch) * frames_per_batch or -1,
        "exploration_type": ExplorationType.RANDOM,
    }
    if policy_device is not None and torch.device(policy_device).type != "cpu":
        common |= {"policy_device": policy_device, "env_device": "cpu", "storing_device": "cpu"}
    plain: dict[str, Any] = {"auto_register_policy_transforms": False}  # ours need none
    if backend == "direct":
        collector = Collector(make_env(seed), policy, use_buffers=False, trust_policy=True, **common, **plain)
        if next(collector.policy.parameters()) is not next(policy.parameters()):  # the loop relies on shared weights
            raise RuntimeError(f"the collector copied the policy: build it on {policy_device}, where it is to run")
        simulation = simulation_env(collector.env)
        if isinstance(simulation, SelfPlayEnv):
            simulation.follow(policy)
        return collector
    if backend in ("process", "ray"):
        factories = [_SeededFactory(make_env, seed + i) for i in range(num_collectors)]
        common |= plain if backend == "process" else _ray_options(num_collectors, plain)
        collector = Collector(factories, policy, backend=backend, num_collectors=num_collectors, sync=sync, **common)
        if backend == "ray":
            collector.update_policy_weights_(policy)  # RayCollector wants that before the first batch
        return collector
    raise ValueError(f"collector backend must be direct, process or ray, got {backend!r}")


def _ray_options(num_collectors: int, plain: dict[str, Any]) -> dict[str, Any]:
    if find_spec("ray") is None:
        raise ImportError("collector=ray needs Ray: pip install 'coachable[cluster]', or choose collector=process")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports its use over the network otherwise
    return {
        "total_frames": sys.maxsize,  # RayCollector has no number for "until it is shut down"
        "collector_kwargs": [plain | {"postproc": _OwnTrajectories(i, num_collectors)} for i in range(num_collectors)],
        "ray_init_config": {"include_dashboard": False, "log_to_driver": False, "logging_level": "warning"},
    }


class _OwnTrajectories:
    """Numbers the trajectories of a worker apart from those of the others: each counts from 0."""

    def __init__(self, worker: int, workers: int) -> None:
        self.worker = worker
        self.workers = workers

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        key = ("collector", "traj_ids")
        return data.set(key, data.get(key) * self.workers + self.worker)


class _SeededFactory:
    """A picklable call of `make_env(seed)`."""

    def __init__(self, make_env: Callable[[int], EnvBase], seed: int) -> None:
        self.make_env = make_env
        self.seed = seed

    def __call__(self) -> EnvBase:
        if multiprocessing.parent_process() is not None and threading.current_thread() is threading.main_thread():
            # Ctrl-C reaches the whole process group: the training process decides when its workers end.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        return self.make_env(self.seed)


def simulation_env(env: EnvBase) -> EnvBase:
    """Peels the transforms off an env."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def collector_state(collector: BaseCollector) -> dict[str, Any]:
    """Reads what the next iteration of a collector depends on, besides policy and global generators.

    Returns:
        Tensors and plain containers: frame count, transforms' state (style generators), the simulation's own state and
        the tensordict that the next step starts from. `not_saved` says why the latter two are missing. Of workers in
        other processes only the counts.
    """
    counts: Any = collector  # typed too narrowly in TorchRL
    state: dict[str, Any] = {
        "frames": int(getattr(counts, "_frames", 0)),
        "iterations": int(getattr(counts, "_iter", 0)),
    }
    if not isinstance(collector, Collector):
        return state
    env = collector.env
    state["transforms"] = dict(env.state_dict()) if isinstance(env, TransformedEnv) else {}
    try:
        state["simulation"] = save_simulator(simulation_env(env))
    except UnsavableError as error:
        return state | {"not_saved": str(error)}
    state["trajectories"] = dict(collector._traj_pool.state_dict())
    state["carrier"] = _plain(collector._carrier)
    return state


def load_collector_state(collector: BaseCollector, state: dict[str, Any]) -> None:
    """Restores what `collector_state` read.

    Args:
        collector: a fresh one, made like the old one.
        state: from `collector_state`.

    Raises:
        UnsavableError: if the running episodes cannot go on; says why. They restart then, and the rest is restored.
    """
    counts: Any = collector  # typed too narrowly in TorchRL
    counts._frames, counts._iter = int(state.get("frames", 0)), int(state.get("iterations", 0))
    if not isinstance(collector, Collector):
        counts.update_policy_weights_()  # for the first step, too
        raise UnsavableError("environments in other processes cannot be saved (collector=direct saves its own)")
    env = collector.env
    if isinstance(env, TransformedEnv):
        env.load_state_dict(state["transforms"])
    if not state.get("simulation"):
        raise UnsavableError(state.get("not_saved", "the checkpoint does not hold their state"))
    carrier, present = state["carrier"], collector._carrier
    saved, expected = tuple(carrier["done"].shape), tuple(present["done"].shape)
    if saved != expected:
        raise UnsavableError(f"the checkpoint holds {saved[0]} environments, this run has {expected[0]} (num_envs)")
    try:
        load_simulator(simulation_env(env), state["simulation"])
    except UnsavableError:
        present.update(env.reset())  # some of it may have been restored
        raise
    collector._traj_pool.load_state_dict(state["trajectories"])
    collector._carrier = TensorDict(carrier, batch_size=present.batch_size).clone()


def evaluate_policy(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    max_steps: int,
    keys: Iterable[str] = (),
    device: torch.device | str = "cpu",
) -> dict[str, float]:
    """Runs one episode per environment; the policy acts as it does by default (`default_interaction_type`).

    Args:
        env: batched env `[N]`; it is reset first, with styles drawn by its sampler.
        policy: writes `action`.
        max_steps: episodes longer than this are cut.
        keys: entries of `next`, (N, 1) each, to average per step beside the returns.
        device: where the policy is.

    Returns:
        `return`, `task_return`, `length`, `survived` (share that did not terminate), one `NAME_per_step` for each key,
        all averaged over episodes.
    """
    wanted = dict.fromkeys(["reward", "task_reward", *keys])
    with preserved_rng(), torch.no_grad():
        td = env.reset()
        running = torch.ones(env.batch_size, dtype=torch.bool, device=td["done"].device)
        fell = torch.zeros_like(running)
        length = torch.zeros_like(running, dtype=torch.float32)
        sums = {key: torch.zeros_like(length) for key in wanted}
        for _ in range(max_steps):
            acted = policy(td.to(device)).to(env.device)
            stepped, td = env.step_and_maybe_reset(acted)
            after = stepped["next"]
            length += running
            for key, total in sums.items():
                value = after.get(key, None)
                if value is not None:
                    total += torch.where(running, value.reshape(running.shape), 0.0)
            fell |= running & after["terminated"].reshape(running.shape)
            running &= ~after["done"].reshape(running.shape)
            if not running.any():
                break
    result = {
        "return": sums["reward"].mean().item(),
        "task_return": sums["task_reward"].mean().item(),
        "length": length.mean().item(),
        "survived": 1.0 - fell.float().mean().item(),
    }
    for key in keys:
        result[f"{key}_per_step"] = (sums[key] / length).mean().item()
    return result


def _plain(td: TensorDictBase) -> dict[str, Any]:
    return {
        str(key): _plain(value) if isinstance(value, TensorDictBase) else value.detach().clone().cpu()
        for key, value in td.items()
    }
