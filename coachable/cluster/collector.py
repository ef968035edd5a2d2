"""`ClusterCollector`: the collector of a training whose workers are Ray actors."""

import contextlib
import queue
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import cloudpickle
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coachable.cluster.connection import ClusterError, Connection
from coachable.cluster.flat_weights import portable_copy, weights_of
from coachable.cluster.worker import MAX_WORKERS, WorkerSettings
from coachable.cluster.workers import Arrival, Loss, Workers
from coachable.code_version import code_version
from coachable.training.async_collector import AsyncCollector

_WAIT = 0.5  # [s] for a batch, after which the workers' error is looked for


class ClusterCollector(AsyncCollector):
    """Collector whose workers are Ray actors, on this host or on a cluster (docs/guides/cluster.md).

    A worker's batch has `num_envs` rows of `steps_per_batch` steps. Batches that wait are taken together, at most one
    of each worker, the rows of one below those of another, because storing each on its own takes too much of the
    learner's time. Each step carries, under `"collector"`, the numbers `worker`, `restart` (how often the worker had
    been started before), `serial` (of the worker's batches since that start) and `version` (updates that its weights
    had seen). Replay buffer and learner stay in this process.

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
        self._weights = weights_of(policy)
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
        """Start the workers, and return an endless iterator of batches `(num_envs * batches, steps_per_batch)`.

        Raises:
            ClusterError: If no worker could be had for `patience` seconds.
        """
        if self._offered < 0:
            self.after_update(self._updates)
        self.workers.start()
        return self._all_batches()

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
            self.workers.offer(updates, self._weights)

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

    def _all_batches(self) -> Iterator[TensorDictBase]:
        while True:
            yield self._take()

    def _take(self) -> TensorDictBase:
        while not self.has_batch(_WAIT):
            pass
        if self._next is None:
            assert self.workers.error is not None
            raise self.workers.error
        taken: list[Arrival] = []
        # Buffers read the steps of all rows in turn, so a worker's next batch has to wait until this one is stored.
        while self._next is not None and all(self._next.worker != item.worker for item in taken):
            taken.append(self._next)
            self._follow(self._next)
            self._next = None
            self.has_batch()
        return _joined(taken)

    def _follow(self, item: Arrival) -> None:
        """Count the env-steps of a batch, and remember which trajectories run on after it."""
        batch = item.batch
        done = batch.entries["next", "done"][:, -1].reshape(batch.shape[0], -1).any(-1)
        self._open[item.worker] = torch.from_numpy(batch.entries["collector", "traj_ids"][:, -1].reshape(-1)[~done])
        self._frames += batch.shape[0] * batch.shape[1]
        self._staleness.append(self._updates - batch.version)

    def _close(self, loss: Loss) -> None:
        warnings.warn(f"a Ray worker was lost: {loss.text}", stacklevel=2)
        if loss.worker in self._open:
            self._closed.append(self._open.pop(loss.worker))


def _joined(items: list[Arrival]) -> TensorDictBase:
    """Return batches one below the other, with the numbers of each beside the trajectory numbers.

    The entries are those that all batches have: random actions come without what the policy would have written.
    """
    batches = [item.batch for item in items]
    keys = [key for key in batches[0].entries if all(key in batch.entries for batch in batches)]
    # Copied, so that the object store can free the memory, and because its arrays are read-only.
    entries = {key: np.concatenate([batch.entries[key] for batch in batches]) for key in keys}
    numbers = np.array([[item.worker, item.start, item.batch.serial, item.batch.version] for item in items])
    num_envs, steps = batches[0].shape
    rows = numbers.repeat(num_envs, axis=0)[:, None].repeat(steps, axis=1)  # (rows, steps, 4)
    entries |= {("collector", name): rows[..., i] for i, name in enumerate(("worker", "restart", "serial", "version"))}
    tensors = {key: torch.from_numpy(value) for key, value in entries.items()}
    return TensorDict(tensors, batch_size=rows.shape[:2])  # pyright: ignore[reportArgumentType]
