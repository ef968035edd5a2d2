"""Construction of collectors, saving and restoring their state, and a short evaluation of a policy."""

import multiprocessing
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import Bounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType

from coachable.keys import TASK_REWARD
from coachable.training.async_collector import AsyncCollector
from coachable.training.rng import preserved_rng, seed_everything
from coachable.training.rollout import Rollout
from coachable.training.simulators import UnsavableError, load_simulator, save_simulator
from coachable.training.worker_errors import ReportingCollector

_ELSEWHERE = "environments in other processes cannot be saved (collector=direct saves its own)"


@runtime_checkable
class SelfPlayEnv(Protocol):
    """Environment in which the agent plays against copies of its own policy."""

    def follow(self, policy: nn.Module) -> None:
        """Set the policy that self-play opponents copy."""
        ...


def make_collector(
    make_env: Callable[[int], EnvBase],
    policy: Any,
    *,
    frames_per_batch: int,
    init_random_frames: int = 0,
    backend: str = "direct",
    num_collectors: int = 1,
    seed: int = 0,
    policy_device: torch.device | str | None = None,
) -> BaseCollector:
    """Build the collector of a training.

    Args:
        make_env: Builds a batched environment `[N]` from a seed. It must be seeded already, because the collector's
            constructor resets it, so that later seeding would miss the first episode.
        policy: The actor. With `backend="direct"` the collector shares it, so that updates need no copy.
        frames_per_batch: Number of env-steps per iteration, a multiple of N.
        init_random_frames: Number of env-steps with uniformly random actions at the start.
        backend: "direct" (this process) or "process" (one host); for several hosts see `coachable.cluster`.
        num_collectors: Number of workers with "process".
        seed: Seed of the environment; with "process" those of the workers are derived from it.
        policy_device: Device of the policy; None for the device of the environment.

    Raises:
        ValueError: If the backend is unknown, "direct" is asked for several workers, or the actions of policy and
            environment have other bounds.
    """
    common: dict[str, Any] = {
        "frames_per_batch": frames_per_batch,
        "total_frames": -1,  # the loop decides when to stop
        # Rounded up to whole iterations, as TorchRL does with a warning.
        "init_random_frames": -(-init_random_frames // frames_per_batch) * frames_per_batch or -1,
        "exploration_type": ExplorationType.RANDOM,
    }
    if policy_device is not None and torch.device(policy_device).type != "cpu":
        common |= {"policy_device": policy_device, "env_device": "cpu", "storing_device": "cpu"}
    plain: dict[str, Any] = {"auto_register_policy_transforms": False}  # the policies here need none
    if backend == "direct":
        if num_collectors != 1:
            raise ValueError(
                f"collector.num_collectors={num_collectors}: collector=direct collects in this process; expected 1, or "
                "collector=process"
            )
        env = make_env(seed)
        require_same_bounds(env, policy)
        collector = Collector(env, policy, use_buffers=False, trust_policy=True, **common, **plain)
        if next(collector.policy.parameters()) is not next(policy.parameters()):  # the loop relies on shared weights
            raise RuntimeError(f"the collector copied the policy: build the policy on {policy_device}, where it runs")
        follow_policy(collector)
        return collector
    if backend == "process":
        factories = [_SeededFactory(make_env, _derived(seed, number)) for number in range(num_collectors)]
        receiver, sender = multiprocessing.Pipe(duplex=False)
        common |= plain | {"collector_class": ReportingCollector(sender, follow_policy)}
        # It waits for all workers in each iteration. TorchRL's asynchronous one drops batches that are not taken within
        # a second.
        workers: Any = Collector(factories, policy, backend=backend, num_collectors=num_collectors, sync=True, **common)
        workers.worker_errors = receiver  # read by `check_workers`
        return workers
    raise ValueError(f"collector backend must be direct or process, got {backend!r}")


def follow_policy(collector: Collector) -> None:
    """Set the policy that the opponents of a `SelfPlayEnv` copy: that of its collector, which the learner updates."""
    simulation: Any = simulation_env(collector.env)
    if isinstance(simulation, SelfPlayEnv):
        policy: Any = collector.policy
        simulation.follow(policy)


def require_same_bounds(env: EnvBase, policy: Any) -> None:
    """Raise a `ValueError` if the actions of a policy have other bounds than those of an environment.

    Such a policy would reach a part of the actions only, or others than there are. An actor without a `spec` of bounded
    actions is not checked.
    """
    spec: Any = getattr(policy, "spec", None)
    own, expected = None if spec is None else spec.get("action", None), env.action_spec
    if not isinstance(own, Bounded) or not isinstance(expected, Bounded) or own.shape[-1] != expected.shape[-1]:
        return
    bounds, own_bounds = _bounds_of(expected), _bounds_of(own)
    differs = ~torch.isclose(bounds, own_bounds).all(0)
    if differs.any():
        entry = int(differs.nonzero()[0])
        (low, high), (own_low, own_high) = bounds[:, entry].tolist(), own_bounds[:, entry].tolist()
        raise ValueError(
            f"entry {entry} of the action ranges over [{low:g}, {high:g}] in the environment, over "
            f"[{own_low:g}, {own_high:g}] in the policy: append torchrl.envs.ActionScaling() to the environment, which "
            "scales actions in [-1, 1]"
        )


def _bounds_of(spec: Any) -> torch.Tensor:
    """Return the bounds (2, width) of a bounded action, of a batch those in its first environment."""
    return torch.stack([spec.space.low, spec.space.high]).reshape(2, -1, spec.shape[-1])[:, 0].double().cpu()


@dataclass(eq=False)
class _SeededFactory:
    """Call of `make_env(seed)` that can be pickled."""

    make_env: Callable[[int], EnvBase]
    seed: int

    def __call__(self) -> EnvBase:
        if multiprocessing.parent_process() is not None and threading.current_thread() is threading.main_thread():
            # Ctrl-C reaches the whole process group, but the training process ends its workers itself.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            seed_everything(self.seed)  # the worker's actions
        return self.make_env(self.seed)


def _derived(seed: int, number: int) -> int:
    """Return a seed below 2^31 that depends on both numbers."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0]) % 2**31


def simulation_env(env: EnvBase) -> EnvBase:
    """Return the environment below all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def collector_state(collector: BaseCollector | AsyncCollector) -> dict[str, Any]:
    """Return everything that a collector's next iteration depends on, except the policy and the global generators.

    Returns:
        Tensors and plain containers: frame count, state of the transforms (style generators) and of the simulation, and
        the tensordict from which the next step starts. `not_saved` is the reason if the latter two are missing. If the
        workers run in other processes, only the counts are returned.
    """
    if isinstance(collector, AsyncCollector):
        return collector.state_dict()
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


def load_collector_state(collector: BaseCollector | AsyncCollector, state: dict[str, Any]) -> None:
    """Restore what `collector_state` returned, into a new collector that was made like the saved one.

    Raises:
        UnsavableError: If the running episodes cannot be continued. They restart, and everything else is restored.
    """
    if isinstance(collector, AsyncCollector):
        collector.load_state_dict(state)
        raise UnsavableError(_ELSEWHERE)
    counts: Any = collector  # typed too narrowly in TorchRL
    counts._frames, counts._iter = int(state.get("frames", 0)), int(state.get("iterations", 0))
    if not isinstance(collector, Collector):
        counts.update_policy_weights_()  # before the first step
        counts.set_seed(_derived(torch.initial_seed(), counts._frames))  # not the starts of frame 0 again
        raise UnsavableError(_ELSEWHERE)
    env = collector.env
    if isinstance(env, TransformedEnv) and "transforms" in state:  # collectors with workers do not save them
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
        present.update(env.reset())  # a part may have been restored
        raise
    collector._traj_pool.load_state_dict(state["trajectories"])
    collector._carrier = TensorDict(carrier, batch_size=present.batch_size).clone()


def evaluate_policy(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    max_steps: int,
    measures: Any = None,
    device: torch.device | str = "cpu",
) -> dict[str, float]:
    """Run one episode per environment, in the policy's default action mode (`default_interaction_type`).

    Args:
        env: Batched environment `[N]`. It is reset first, with styles drawn by its sampler.
        policy: Writes `action`.
        max_steps: Number of steps after which an episode is cut.
        measures: Measured style, see `coachable.domain.StyleMeasures`.
        device: Device of the policy.

    Returns:
        `return`, `task_return`, `length`, `survived` (share of episodes that did not terminate), and the measures by
        their names, all averaged over the episodes that have a value.
    """
    with preserved_rng(), torch.no_grad():
        rollout = Rollout(env)
        rollout.begin()
        fell = torch.zeros(env.batch_size, dtype=torch.bool, device=env.device)
        length = torch.zeros_like(fell, dtype=torch.float32)
        sums = {key: torch.zeros_like(length) for key in ("reward", TASK_REWARD)}
        measured, alive = [], []
        for stepped, running in rollout.episode(lambda td: policy(td.to(device)).to(env.device or "cpu"), max_steps):
            rollout.begin_ended()
            after: Any = stepped.get("next")
            if measures is not None:
                measured.append(measures.step(stepped))
                alive.append(running)
            length += running
            for key, total in sums.items():
                value = after.get(key, None)
                if value is not None:
                    total += torch.where(running, value.reshape(running.shape), 0.0)
            fell |= running & after["terminated"].reshape(running.shape)
    result = {
        "return": sums["reward"].mean().item(),
        "task_return": sums[TASK_REWARD].mean().item(),
        "length": length.mean().item(),
        "survived": 1.0 - fell.float().mean().item(),
    }
    if measures is not None:
        record = {name: torch.stack([row[name] for row in measured]) for name in measured[0]}
        summary = measures.summarise(record, torch.stack(alive))
        result |= {name: values.nanmean().item() for name, values in summary.items()}
    return result


def _plain(td: TensorDictBase) -> dict[str, Any]:
    return {
        str(key): _plain(value) if isinstance(value, TensorDictBase) else value.detach().clone().cpu()
        for key, value in td.items()
    }
