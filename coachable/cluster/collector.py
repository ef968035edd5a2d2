"""`ClusterCollector`: the collector of a training whose workers are Ray actors."""

import contextlib
import queue
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import cloudpickle
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coachable.cluster.connection import ClusterError, Connection
from coachable.cluster.flat_weights import flat_weights, portable_copy
from coachable.cluster.worker import MAX_WORKERS, WorkerSettings
from coachable.cluster.workers import Arrival, Loss, Workers
from coachable.code_version import code_version
from coachable.training.async_collector import AsyncCollector

__all__ = ["ClusterCollector"]

_WAIT = 0.5  # [s] for a batch, after which the workers' error is looked for


class ClusterCollector(AsyncCollector):
    """Collector whose workers are Ray actors, on this host or on a cluster (docs/guides/cluster.md).

    Each batch `(num_envs, steps_per_batch)` comes from one worker and carries, under `"collector"`, the numbers
    `worker`, `restart` (how often the worker had been started before), `serial` (of the worker's batches since that
    start) and `version` (updates that its weights had seen). Replay buffer and learner stay in this process.

    Args:
        make_env: Builds a seeded, batched environment `[N]` from a seed.
        policy: The actor, of which every worker gets a copy.
        frames_per_batch: Number of env-steps of one step of all environments of all workers.
        init_random_frames: Number of env-steps with uniformly random actions at the start.
        num_collectors: Number of workers.
        steps_per_batch: Number of steps of each environment in a batch.
        seed: Seed of the training. A worker's random numbers depend on it, on its number and on its restarts.
        policy_device: Device of the policy in this process; workers act on the CPU.
        address: HOST:PORT of a cluster, "auto" for the one on this host, or None for `RAY_ADDRESS` and without it a
            local Ray.
        cpus_per_worker: Number of cores that each worker reserves; a share such as 0.1 puts several on one core.
        group_size: Number of workers of one Ray actor, which reserves the cores of all on one node. If there are
            several, each is a process that shares the memory of Python and torch with the others.
        weights_every: Number of updates between two offers of weights to the workers.
        queue_size: Number of batches that wait for the learner before workers are no longer asked for more.
        worker_throttle: Highest rate of each worker [env-steps/s]; None for no limit.
        patience: Time without any batch after which the training ends [s]. A single worker that does not start within
            it, or does not answer for half of it, is replaced.

    Raises:
        ImportError: If Ray is not installed.
        ValueError: If a number is out of range.
        ClusterError: If the cluster cannot be used, or environment or policy cannot be pickled.
    """

    def __init__(
        self,
        make_env: Callable[[int], EnvBase],
        policy: nn.Module,
        *,
        frames_per_batch: int,
        init_random_frames: int = 0,
        num_collectors: int = 1,
        steps_per_batch: int = 8,
        seed: int = 0,
        policy_device: torch.device | str | None = None,
        address: str | None = None,
        cpus_per_worker: float = 1.0,
        group_size: int = 1,
        weights_every: int = 1,
        queue_size: int = 16,
        worker_throttle: float | None = None,
        patience: float = 300.0,
    ) -> None:
        if num_collectors > MAX_WORKERS:
            raise ValueError(f"collector.num_collectors={num_collectors}: expected at most {MAX_WORKERS}")
        if group_size < 1:
            raise ValueError(f"collector.group_size={group_size}: expected at least 1")
        frames = frames_per_batch // num_collectors * steps_per_batch
        if worker_throttle is not None and 2 * frames / worker_throttle >= patience / 2:
            raise ValueError(
                f"collector.patience={patience:g}: a batch of {frames} env-steps takes {frames / worker_throttle:g} s "
                f"at collector.worker_throttle={worker_throttle:g}; expected more than four times as much"
            )
        try:
            task = cloudpickle.dumps((make_env, portable_copy(policy)))
        except Exception as error:  # objects raise what they like when they are pickled
            raise ClusterError(
                f"collector=ray cannot send make_env and the policy to its workers: {type(error).__name__}: {error}; "
                "expected a make_env that makes its simulator itself, or collector=direct"
            ) from error
        self.policy = policy
        self.weights_every = weights_every
        self.init_random_frames = init_random_frames
        self._frames_per_worker = frames
        self._frames = 0  # that were taken
        self._asked = 0  # that were asked for
        self._updates = 0
        self._offered = -1
        self._open: dict[int, Tensor] = {}  # running trajectories by worker
        self._closed: list[Tensor] = []
        self._next: Arrival | None = None  # that `has_batch` took from the queue
        self._staleness: list[int] = []
        self._connection = Connection(
            address, num_collectors, cpus_per_worker, patience, min(group_size, num_collectors)
        )
        code = code_version()

        def settings(worker: int, start: int) -> WorkerSettings:
            return WorkerSettings(worker, start, seed, steps_per_batch, worker_throttle, code)

        self.workers = Workers(
            self._connection.ray,
            task,
            num_collectors,
            settings,
            cpus_per_worker,
            group_size,
            queue_size,
            patience,
            self._connection.starts_at_once(),
            self._is_random,
        )

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Start the workers, and return an iterator of their batches `(num_envs, steps_per_batch)` without end.

        Raises:
            ClusterError: If no worker could be had for `patience` seconds.
        """
        if self._offered < 0:
            self.after_update(self._updates)
        self.workers.start()
        return iter(self._take, None)

    def has_batch(self, wait: float = 0.0) -> bool:
        """Return whether the next batch, or an error instead of it, is here, so that taking it does not wait.

        Args:
            wait: Longest time to wait for it [s].
        """
        with contextlib.suppress(queue.Empty):
            while self._next is None:
                item = self.workers.arrivals.get(timeout=wait)
                if isinstance(item, Loss):
                    self._close(item)
                else:
                    self._next = item
        return self._next is not None or self.workers.error is not None

    def after_update(self, updates: int) -> None:
        """Offer the policy's weights to the workers, every `weights_every` updates."""
        self._updates = updates
        if self._offered < 0 or updates - self._offered >= self.weights_every:
            self._offered = updates
            self.workers.offer(updates, flat_weights(self.policy))

    def interrupted(self) -> Tensor:
        """Return the numbers `(trajectories,)` of those that ended with their worker since the last call."""
        closed, self._closed = self._closed, []
        return torch.cat([torch.zeros(0, dtype=torch.long), *closed])

    def metrics(self) -> dict[str, float]:
        """Return staleness [updates] since the last call, workers alive, restarts so far, and the queue's length."""
        staleness, self._staleness = self._staleness or [0], []
        return {
            "workers/staleness": sum(staleness) / len(staleness),
            "workers/staleness_max": max(staleness),
            "workers/alive": self.workers.alive(),
            "workers/restarts": self.workers.restarts,
            "workers/queue": self.workers.arrivals.qsize(),
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the number of env-steps and how often each worker was started."""
        return {"frames": self._frames, "starts": [slot.starts for slot in self.workers.slots]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned; workers draw other random numbers than before the interruption."""
        self._frames = self._asked = int(state.get("frames", 0))
        for slot, starts in zip(self.workers.slots, state.get("starts", []), strict=False):
            slot.starts = int(starts)

    def shutdown(self) -> None:
        """End all workers, and a Ray that was started here."""
        self.workers.stop()
        self._connection.close()

    def _is_random(self) -> bool:
        is_random = self._asked < self.init_random_frames
        self._asked += self._frames_per_worker
        return is_random

    def _take(self) -> TensorDictBase:
        while not self.has_batch(_WAIT):
            pass
        if self._next is None:
            assert self.workers.error is not None
            raise self.workers.error
        item, self._next = self._next, None
        return self._batch(item)

    def _close(self, loss: Loss) -> None:
        warnings.warn(f"a Ray worker was lost: {loss.text}", stacklevel=2)
        if loss.worker in self._open:
            self._closed.append(self._open.pop(loss.worker))

    def _batch(self, item: Arrival) -> TensorDictBase:
        batch = item.batch
        # Copied, so that the object store can free the memory, and because its arrays are read-only.
        entries = {key: torch.from_numpy(value.copy()) for key, value in batch.entries.items()}
        data = TensorDict(entries, batch_size=batch.shape)  # pyright: ignore[reportArgumentType]
        numbers = {"worker": item.worker, "restart": item.start, "serial": batch.serial, "version": batch.version}
        for name, number in numbers.items():
            data.set(("collector", name), torch.full(batch.shape, number))
        last: Any = data[:, -1]
        running = ~last.get(("next", "done")).reshape(len(last), -1).any(-1)
        self._open[item.worker] = last.get(("collector", "traj_ids")).reshape(-1)[running]
        self._frames += data.numel()
        self._staleness.append(self._updates - batch.version)
        return data
