"""Ray actor with one rollout worker, or with a group of them in processes of their own."""

import os
import threading
from typing import Any

from coachable.cluster.forked_worker import ForkedWorker
from coachable.cluster.worker import Batch, RolloutWorker, WorkerSettings

Key = tuple[int, int]  # a worker's number, and how often it had been started before


class WorkerHost:
    """Ray actor that forwards calls to its workers, each of which may be called from a different thread.

    Args:
        forks: Whether each worker gets a process of its own. Without it there is only one worker, in this process.
    """

    def __init__(self, forks: bool) -> None:
        self._forks = forks
        self._workers: dict[Key, RolloutWorker | ForkedWorker] = {}
        self._loaded: dict[Key, int] = {}  # versions of their weights
        self._weights = _NewestWeights()

    def start(self, task: bytes, settings: WorkerSettings) -> tuple[int, str]:
        """Start a worker; see `RolloutWorker.start`."""
        key = settings.worker, settings.start
        worker = self._workers[key] = ForkedWorker() if self._forks else RolloutWorker()
        return worker.start(task, settings)

    def collect(self, key: Key, version: int, weights: list[Any], random: bool) -> Batch:
        """Let a worker collect a batch with the newest weights that have arrived at this node.

        Args:
            key: The worker.
            version: Number of updates that the newest weights have seen.
            weights: The reference of these weights, in a list, so that Ray does not wait for them.
            random: Whether to act with uniformly random actions.
        """
        worker = self._workers[key]
        version, file = self._weights.take((version, weights[0]))
        with open(file, "rb") as opened:
            if version > self._loaded.get(key, -1):
                worker.load(version, opened.fileno())
                self._loaded[key] = version
        return worker.collect(random)

    def end(self, key: Key) -> None:
        """End a worker that has a process of its own."""
        self._loaded.pop(key, None)
        worker = self._workers.pop(key, None)
        if isinstance(worker, ForkedWorker):
            worker.kill()


class _NewestWeights:
    """Newest weights that have arrived at this node; each version is a file in memory that other processes can read."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._version = self._file = -1
        self._coming: tuple[int, Any] | None = None

    def take(self, newest: tuple[int, Any]) -> tuple[int, int]:
        """Take the newest weights that have arrived; only the first ones are waited for.

        Args:
            newest: Version and reference of the newest weights that the learner offers.

        Returns:
            Version of the weights, and a descriptor of their file, which the caller has to close.
        """
        with self._lock:
            self._take(newest)
            return self._version, os.dup(self._file)

    def _take(self, newest: tuple[int, Any]) -> None:
        import ray

        for _ in range(2):  # those that were on their way, then those that the learner offers now
            if self._coming is None and newest[0] > self._version:
                self._coming = newest
            if self._coming is None:
                return
            version, reference = self._coming
            if self._version >= 0 and not ray.wait([reference], timeout=0)[0]:
                return
            self._write(ray.get(reference))
            self._version, self._coming = version, None

    def _write(self, flat: Any) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file = os.memfd_create("weights")
        with open(self._file, "wb", closefd=False) as file:
            file.write(flat)
