"""Driver's side of the workers: a thread that asks them for batches and replaces those that die."""

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from coachable.cluster.connection import ClusterError
from coachable.cluster.flat_weights import flat_weights
from coachable.cluster.forked_worker import ProcessDiedError
from coachable.cluster.worker import Batch, WorkerSettings
from coachable.cluster.worker_host import WorkerHost

_LONGEST_PAUSE = 60.0  # [s] before a worker that fails again and again is started anew
_WAIT = 0.1  # [s] of one wait for answers, after which everything else is looked at
_WAIT_FOR_ROOM = 0.01  # [s] the same while workers are idle because the queue is full


@dataclass(frozen=True)
class Arrival:
    """Batch of a worker, in the queue."""

    worker: int
    start: int
    batch: Batch


@dataclass(frozen=True)
class Loss:
    """Notice in the queue that a worker was lost, after all its batches."""

    worker: int
    text: str


@dataclass(eq=False)
class Slot:
    """Place of a worker, which is filled again when the worker is lost.

    Attributes:
        worker: Number of the worker.
        starts: How often it was started in the whole run.
        actor: The Ray actor that it belongs to, or None until it is started again.
        call: Reference of the answer that it owes, or None while it is idle.
        is_ready: Whether it has started, so that `call` is a batch.
        since: Time of the call [s].
        failures: Number of losses since its last batch.
        retry: Time at which it is started again [s].
        pid: Its process.
        host: Its host.
    """

    worker: int
    starts: int = 0
    actor: Any = None
    call: Any = None
    is_ready: bool = False
    since: float = 0.0
    failures: int = 0
    retry: float = 0.0
    pid: int = 0
    host: str = ""

    def key(self) -> tuple[int, int]:
        """Return what `WorkerHost` knows the worker by: its number, and how often it had been started before."""
        return self.worker, self.starts - 1


@dataclass
class Workers:
    """Workers and the thread that serves them.

    Every worker owes at most one answer. While fewer than `queue_size` batches wait for the learner, an idle worker is
    asked for the next one, with the newest weights. A worker that dies, raises an error, does not answer for half of
    `patience` or does not start within it is replaced by a new actor, after a pause that doubles with every failure.

    Args:
        ray: The module of Ray.
        task: `(make_env, policy)`, pickled.
        count: Number of workers.
        settings: Returns the settings of a worker from its number and start.
        cpus_per_worker: Number of cores that each reserves.
        group_size: Number of workers that one Ray actor starts, each in a process of its own if there are several.
        queue_size: Number of batches that wait before workers are no longer asked.
        patience: Time without any batch or start after which the training ends [s].
        starts_at_once: Number of workers that may start at the same time, because each keeps a core busy for seconds.
        is_random: Returns whether the next batch is collected with random actions.
    """

    ray: Any
    task: bytes
    count: int
    settings: Callable[[int, int], WorkerSettings]
    cpus_per_worker: float
    group_size: int
    queue_size: int
    patience: float
    starts_at_once: int
    is_random: Callable[[], bool]
    arrivals: queue.SimpleQueue[Arrival | Loss] = field(default_factory=queue.SimpleQueue)
    error: BaseException | None = None
    restarts: int = 0

    def __post_init__(self) -> None:
        self.slots = [Slot(number) for number in range(self.count)]
        self._weights_lock = threading.Lock()
        self._flat: Tensor | None = None  # the newest weights
        self._version = -1  # theirs
        self._stored = -1  # the version of those in the object store
        self._reference: Any = None
        self._actors: dict[int, Any] = {}  # by group
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._last = 0.0  # when a batch arrived, a worker started, or the queue was full [s]
        self._raised: set[int] = set()  # workers that raised an error before any batch arrived
        self._delivered = False
        self._reason = "none has started"

    def offer(self, version: int, weights: list[Tensor]) -> None:
        """Offer a copy of weights from `weights_of`, which workers get with their next request; `version` rises."""
        with self._weights_lock:
            self._flat = flat_weights(weights, self._flat)
            self._version = version

    def start(self) -> None:
        """Start the workers and the thread."""
        self._last = time.monotonic()
        self._thread = threading.Thread(target=self._serve, name="ray workers", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and the workers."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        for slot in self.slots:
            self._kill(slot)
        for actor in self._actors.values():
            self.ray.kill(actor, no_restart=True)

    def alive(self) -> int:
        """Return the number of workers that have started and were not lost."""
        return sum(slot.is_ready for slot in self.slots)

    def _serve(self) -> None:
        try:
            while not self._stop.is_set():
                self._receive()
                now = time.monotonic()
                starting = sum(slot.actor is not None and not slot.is_ready for slot in self.slots)
                for slot in self.slots:
                    if slot.actor is None and slot.retry <= now and starting < self.starts_at_once:
                        self._launch(slot)
                        starting += 1
                    elif slot.call is not None and now - slot.since > self._limit(slot):
                        self._lose(slot, f"it did not answer for {self._limit(slot):g} s (see collector.patience)")
                self._ask()
                self._check_patience()
        except BaseException as error:
            self.error = error

    def _limit(self, slot: Slot) -> float:
        """Return the time for an answer [s]: all of the patience for a start, which needs cores and imports."""
        return self.patience / 2 if slot.is_ready else self.patience

    def _launch(self, slot: Slot) -> None:
        group = slot.worker // self.group_size
        if group not in self._actors:
            size = min(self.group_size, self.count - group * self.group_size)
            actor = self.ray.remote(WorkerHost).options(
                num_cpus=self.cpus_per_worker * size,
                max_concurrency=1 if self.group_size == 1 else 2 * size,  # also for ending workers that hang
                scheduling_strategy="SPREAD",
                max_restarts=0,
                max_task_retries=0,
            )
            self._actors[group] = actor.remote(self.group_size > 1)
        slot.actor = self._actors[group]
        slot.call = slot.actor.start.remote(self.task, self.settings(slot.worker, slot.starts))
        slot.starts += 1
        slot.since = time.monotonic()

    def _receive(self) -> None:
        slots = {slot.call: slot for slot in self.slots if slot.call is not None}
        has_idle = len(slots) < sum(slot.actor is not None for slot in self.slots)
        if not slots:
            self._stop.wait(_WAIT_FOR_ROOM if has_idle else _WAIT)
            return
        ready, _ = self.ray.wait(list(slots), num_returns=1, timeout=_WAIT_FOR_ROOM if has_idle else _WAIT)
        if ready and len(slots) > 1:
            ready, _ = self.ray.wait(list(slots), num_returns=len(slots), timeout=0)
        for reference in ready:
            slot = slots[reference]
            try:
                answer = self.ray.get(reference)
            except self.ray.exceptions.RayError as error:
                if isinstance(error, self.ray.exceptions.RayActorError):
                    self._forget(slot.actor)
                self._lose(slot, self._reason_of(error), raised=self._is_raised(error))
                continue
            slot.call = None
            if not slot.is_ready:
                slot.is_ready = True
                slot.pid, slot.host = answer
                if not slot.failures:  # one that dies after every start does not count
                    self._last = time.monotonic()
                continue
            slot.failures = 0
            self._last, self._delivered = time.monotonic(), True
            self.arrivals.put(Arrival(slot.worker, slot.starts - 1, answer))

    def _ask(self) -> None:
        idle = [slot for slot in self.slots if slot.is_ready and slot.call is None]
        for slot in sorted(idle, key=lambda slot: slot.since):  # whoever was asked longest ago comes first
            if self.arrivals.qsize() >= self.queue_size:
                self._last = time.monotonic()  # the workers wait for the learner, not the other way round
                return
            version, reference = self._stored_weights()
            slot.call = slot.actor.collect.remote(slot.key(), version, [reference], self.is_random())
            slot.since = time.monotonic()

    def _stored_weights(self) -> tuple[int, Any]:
        """Return the version and the reference of the newest weights, which are put into the object store if new."""
        with self._weights_lock:
            if self._version > self._stored and self._flat is not None:
                try:
                    self._reference = self.ray.put(self._flat.numpy())
                    self._stored = self._version
                except (self.ray.exceptions.ObjectStoreFullError, self.ray.exceptions.OutOfDiskError) as error:
                    if self._reference is None:
                        raise ClusterError(
                            f"collector=ray: the weights ({self._flat.numel() * 4 / 1e6:.0f} MB) do not fit into Ray's "
                            "object store: start Ray with a larger --object-store-memory"
                        ) from error
        return self._stored, self._reference

    def _lose(self, slot: Slot, reason: str, raised: bool = False) -> None:
        """Give a worker up, and plan its replacement."""
        self._kill(slot)
        pause = min(_LONGEST_PAUSE, 2.0**slot.failures)
        slot.failures += 1
        slot.retry = time.monotonic() + pause
        self.restarts += 1
        where = f" on {slot.host}" if slot.host else ""
        self._reason = f"worker {slot.worker}{where}: {reason}"
        self.arrivals.put(Loss(slot.worker, f"{self._reason}. It is started again in {pause:g} s"))
        if raised and not self._delivered:
            self._raised.add(slot.worker)
            if len(self._raised) == self.count:
                raise ClusterError(f"every Ray worker fails before its first batch; {self._reason}.")

    def _kill(self, slot: Slot) -> None:
        group = slot.worker // self.group_size
        if slot.actor is not None and slot.actor is self._actors.get(group):
            if self.group_size == 1:
                self.ray.kill(self._actors.pop(group), no_restart=True)
            else:
                slot.actor.end.remote(slot.key())
        slot.actor = slot.call = None
        slot.is_ready = False

    def _forget(self, actor: Any) -> None:
        """Do without an actor that has died, so that its workers start in a new one."""
        self._actors = {group: other for group, other in self._actors.items() if other is not actor}

    def _check_patience(self) -> None:
        if time.monotonic() - self._last > self.patience:
            raise ClusterError(
                f"no Ray worker delivered a batch for {self.patience:g} s (collector.patience); {self._reason}."
            )

    def _is_raised(self, error: Any) -> bool:
        """Return whether a worker has raised an error, and did not just end."""
        return isinstance(error, self.ray.exceptions.RayTaskError) and not isinstance(error.cause, ProcessDiedError)

    def _reason_of(self, error: Any) -> str:
        exceptions = self.ray.exceptions
        if isinstance(error, exceptions.RayTaskError):
            cause = error.cause if isinstance(error.cause, BaseException) else error
            if isinstance(cause, ProcessDiedError):
                return str(cause)
            lines = [line.strip() for line in str(cause).splitlines() if line.strip()] or [""]
            return f"{type(cause).__name__}: {lines[-1] if cause is error else lines[0]}".rstrip(".")
        if isinstance(error, exceptions.RayActorError):
            return "its node was lost" if "node" in str(error).lower() and "died" in str(error) else "its process died"
        return type(error).__name__
