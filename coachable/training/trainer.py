"""Training loop: collect, store, update, evaluate, log and write checkpoints."""

import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from coachable.files import refusing
from coachable.finite import NonFiniteError, require_finite
from coachable.keys import EVENTS, SCENARIO, STYLE, STYLE_FEATURES, TASK_REWARD
from coachable.replay import EventTableBuffer
from coachable.replay.replay_files import read_replay
from coachable.training.async_collector import AsyncCollector
from coachable.training.checkpoint import CheckpointStore, find_checkpoint, read_state
from coachable.training.collection import collector_state, load_collector_state, simulation_env
from coachable.training.episodes import EpisodeStatistics, EpisodeWatch, Means
from coachable.training.learner import Learner
from coachable.training.logging import MetricsLog, Progress
from coachable.training.rng import rng_state, set_rng_state
from coachable.training.simulators import UnsavableError
from coachable.training.stopping import stop_signals
from coachable.training.throttle import Throttle
from coachable.training.train_settings import TrainSettings
from coachable.training.weights import require_same_agent
from coachable.training.worker_errors import WorkerError, update_workers, worker_errors

_WAIT = 0.5  # [s] for a batch of workers, after which a signal to stop is looked for

REPLAY_KEYS: tuple[NestedKey, ...] = (
    "observation",
    "action",
    STYLE,
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
    ("next", TASK_REWARD),
    ("next", STYLE_FEATURES),
)
"""Keys of the entries that losses and relabelling read. `("next", "style")` equals `style` and is not stored."""


def replay_keys(env: EnvBase, *, tables: bool = False, scenarios: bool = False) -> tuple[NestedKey, ...]:
    """Return the keys of the entries that a replay buffer stores of each transition.

    Args:
        env: The environment; its observation spec shows whether it emits events and scenarios.
        tables: Whether the buffer is an `EventTableBuffer`, which reads trajectory numbers and events.
        scenarios: Whether the buffer has one table per scenario.
    """
    if not tables:
        return REPLAY_KEYS
    emitted = env.observation_spec.keys()
    events: tuple[NestedKey, ...] = (("next", EVENTS),) if EVENTS in emitted else ()
    scenario: tuple[NestedKey, ...] = (SCENARIO,) if scenarios and SCENARIO in emitted else ()
    return (*REPLAY_KEYS, ("collector", "traj_ids"), *events, *scenario)


class Trainer:
    """Training loop that runs until `total_frames`, a stop signal or an error.

    Args:
        collector: TorchRL collector, or an `AsyncCollector`.
        replay: Replay buffer whose `sample(batch_size)` returns batches for the learner.
        learner: Learner that makes the updates.
        settings: Settings of the loop, see `TrainSettings`.
        log: Log that receives a row of metrics now and then.
        progress: Progress display.
        checkpoints: Store of the run's checkpoints; None writes none.
        describe: Returns the agent's style space, network, configuration and weights, which every checkpoint contains.
        evaluate: Returns metrics of an evaluation. It must leave the global random number generators unchanged.
        style_terms: Maps style features `(B, F)` and theta `(B, d)` to named, unscaled terms `(B,)` for the log.
        replay_keys: Keys of the stored entries, see the function `replay_keys`.

    Raises:
        ValueError: If a batch is larger than the replay buffer, so that there would be no update.
    """

    def __init__(
        self,
        *,
        collector: BaseCollector | AsyncCollector,
        replay: ReplayBuffer,
        learner: Learner,
        settings: TrainSettings,
        log: MetricsLog,
        progress: Progress,
        checkpoints: CheckpointStore | None = None,
        describe: Callable[[], Mapping[str, Any]] = dict,
        evaluate: Callable[[], Mapping[str, float]] | None = None,
        style_terms: Callable[[Any, torch.Tensor], Mapping[str, torch.Tensor]] | None = None,
        replay_keys: tuple[NestedKey, ...] = REPLAY_KEYS,
    ) -> None:
        if settings.batch_size > replay.storage.max_size:
            raise ValueError(
                f"batch_size={settings.batch_size}: expected at most {replay.storage.max_size}, the capacity of the "
                "replay buffer, because otherwise no update would be made"
            )
        self.collector = collector
        self.replay = replay
        self.learner = learner
        self.settings = settings
        self.log = log
        self.progress = progress
        self.checkpoints = checkpoints
        self.describe = describe
        self.evaluate = evaluate
        self.replay_keys = replay_keys
        self.frames = 0
        self.stopped = False  # whether a signal asked the last run to end
        self.saved = True  # whether the latest checkpoint could be written
        self.pending_updates = 0.0  # updates that utd_ratio asks for and that have not been made yet
        parts = ("collect", "store", "update", "evaluate", "log", "checkpoint", "wait")
        self.seconds: dict[str, float] = dict.fromkeys(parts, 0.0)
        self._device = next(learner.loss_module.parameters()).device
        for factor in (settings.entropy_factor(settings.total_frames), 1.0):
            learner.scale_entropy_weight(factor)  # refuses now what it cannot scale later
        self._throttle = Throttle(settings.throttle)
        self._episodes = EpisodeStatistics(style_terms)
        self._watch = EpisodeWatch()
        self._losses = Means()
        self._latest: dict[str, float] = {}
        self._evaluations = self._logged_frames = self._filled_from = 0  # the last: when the replay buffer was empty
        self._evaluated_frames = -1
        self._logged = self._saved = time.monotonic()
        self._saved_frames = -1  # env-steps of the checkpoint in the run's own folder that was resumed

    def run(self) -> dict[str, float]:
        """Run the loop.

        Returns:
            The latest value of every metric.

        Raises:
            NonFiniteError: If a number in a transition, loss or gradient is not finite, or a weight was not finite at
                the start. Such a number is not stored, no weight is changed by it, and no checkpoint is written.
            WorkerError: If a worker process ended with an error, or no worker can be had; no checkpoint is written.
        """
        if self.frames == 0:
            self.log.rewind(0)  # drops rows of a training that was killed before its first checkpoint
        self.progress.start(self.frames, self.learner.updates)
        if isinstance(self.collector, AsyncCollector):
            self.collector.after_update(self.learner.updates)  # of a checkpoint, if this training is resumed
        try:
            self.learner.check_weights()
            with stop_signals() as stop:
                try:
                    with worker_errors(self.collector):
                        self._loop(stop)
                except WorkerError:
                    if not stop.is_set():  # a signal to the whole process group ends the workers, too
                        raise
                self._finish(interrupted=stop.is_set())
                self.stopped = stop.is_set()
        except (NonFiniteError, WorkerError) as error:
            error.args = (f"{error} The training stopped at env-step {self.frames:,}, without another checkpoint.",)
            raise
        finally:
            self.progress.close()
            self.log.close()
            self.collector.shutdown()
        return self._latest

    def _loop(self, stop: threading.Event) -> None:
        batches = iter(self.collector)
        while self.frames < self.settings.total_frames and self._await_batch(stop):
            data = self._collect(batches)
            self._store(data)
            self._update(data.numel(), stop)
            self._evaluate_if_due()
            self._log_if_due()
            self._checkpoint_if_due()

    def _await_batch(self, stop: threading.Event) -> bool:
        """Wait until workers have a batch or a signal asks to stop; return whether the training goes on."""
        with self._timed("collect"):
            while isinstance(self.collector, AsyncCollector) and not stop.is_set():
                if self.collector.has_batch(wait=_WAIT):
                    break
        return not stop.is_set()

    def _collect(self, batches: Iterator[TensorDictBase]) -> TensorDictBase:
        with self._timed("wait"):
            self._throttle.wait()
        with self._timed("collect"):
            data = next(batches)
        self.frames += data.numel()
        self._throttle.add(data.numel())
        return data

    def _store(self, data: TensorDictBase) -> None:
        with self._timed("store"):
            data = data.contiguous()  # without this, flattening the lazy stack takes 25 times as long
            stored = data.select(*self.replay_keys)
            require_finite(stored)
            self._episodes.add(data.reshape(-1))
            if not isinstance(self.collector, AsyncCollector):  # whose batches are of one worker each
                self._watch.add(data)
            steps = stored.shape[-1:] if isinstance(self.replay, EventTableBuffer) else ()  # its rows are environments
            self.replay.extend(stored.reshape(-1, *steps))
            if isinstance(self.collector, AsyncCollector) and isinstance(self.replay, EventTableBuffer):
                self.replay.finish(self.collector.interrupted())

    def _update(self, new_frames: int, stop: threading.Event) -> None:
        warming_up = self.frames - self._filled_from <= self.settings.warmup_frames
        if warming_up or len(self.replay) < self.settings.batch_size:
            return
        with self._timed("update"), self.learner.backend.working():
            self.learner.scale_learning_rates(self.settings.learning_rate_factor(self.frames))
            self.learner.scale_entropy_weight(self.settings.entropy_factor(self.frames))
            if self.settings.utd_ratio is None:  # update until the next frames are allowed and, from workers, here
                while (self._throttle.remaining() > 0 or self._waits_for_workers()) and not stop.is_set():
                    self._update_once()
            else:
                self.pending_updates += new_frames * self.settings.utd_ratio
                may_stop = isinstance(self.collector, AsyncCollector)  # other trainings resume at the end of a round
                while self.pending_updates >= 1.0 and not (may_stop and stop.is_set()):
                    self._update_once()
                    self.pending_updates -= 1.0
            # A single-process collector shares the learner's weights, and an `AsyncCollector` hears of every update.
            if not isinstance(self.collector, Collector | AsyncCollector):
                update_workers(self.collector)

    def _update_once(self) -> None:
        batch = self.replay.sample(self.settings.batch_size).to(self._device)
        if ("next", STYLE) not in batch.keys(True):
            batch.set(("next", STYLE), batch.get(STYLE))  # theta does not change within a training episode
        self._losses.add(self.learner.update(batch))
        if isinstance(self.replay, EventTableBuffer):
            self.replay.update_tensordict_priority(batch)
        if isinstance(self.collector, AsyncCollector):
            self.collector.after_update(self.learner.updates)

    def _waits_for_workers(self) -> bool:
        return isinstance(self.collector, AsyncCollector) and not self.collector.has_batch()

    def _evaluate_if_due(self) -> None:
        interval = self.settings.eval_interval
        if interval and self.frames // interval > self._evaluations:
            self._evaluations = self.frames // interval
            self._evaluate()

    def _evaluate(self) -> None:
        if self.evaluate is None:
            return
        with self._timed("evaluate"):
            metrics = {f"eval/{name}": value for name, value in self.evaluate().items()}
        self._evaluated_frames = self.frames
        self._latest |= metrics
        self._write(metrics)

    def _log_if_due(self) -> None:
        if time.monotonic() - self._logged >= self.settings.log_interval:
            self._log()
        self.progress.update(self.frames, self.learner.updates, self._latest)

    def _log(self) -> None:
        with self._timed("log"):
            self._logged, self._logged_frames = time.monotonic(), self.frames
            row = {**self._episodes.flush(), **{f"loss/{k}": v for k, v in self._losses.flush().items()}}
            row |= {f"seconds/{name}": round(spent, 3) for name, spent in self.seconds.items()}
            if isinstance(self.replay, EventTableBuffer):
                tables = self.replay.statistics()
                row |= {f"tables/{name}/{key}": tables[name][key] for name in tables for key in ("size", "events")}
            if isinstance(self.collector, AsyncCollector):
                row |= self.collector.metrics()
            self._latest |= row
            self._write(row)

    def _write(self, row: Mapping[str, float]) -> None:
        minutes = round(sum(self.seconds.values()) / 60, 3)  # without pauses between a stop and its resumption
        try:
            self.log.write({**self._position(), "minutes": minutes, **row})
        except OSError as error:  # a full disk must not end a training
            warnings.warn(f"metrics at {self.frames} frames were not written: {error}", stacklevel=2)

    def _position(self) -> dict[str, float]:
        return {"frames": self.frames, "updates": self.learner.updates}

    def _checkpoint_if_due(self) -> None:
        if time.monotonic() - self._saved >= self.settings.checkpoint_interval:
            if self._logged_frames < self.frames:  # a checkpoint does not contain the statistics since the last row
                self._log()
            self._checkpoint()

    def _checkpoint(self) -> None:
        if self.checkpoints is not None:
            with self._timed("checkpoint"):
                self.learner.check_finite()
                state = {**self.describe(), **self.state_dict()}
                self.saved = self.checkpoints.try_save(state, self._position(), self.replay) is not None
                self._saved = time.monotonic()

    def _finish(self, *, interrupted: bool) -> None:
        # Neither row is repeated if the training was resumed at its end or has just been evaluated.
        evaluates = not interrupted and self._evaluated_frames < self.frames
        if evaluates:
            self._evaluate()
        if self._logged_frames < self.frames:
            self._log()
        if evaluates or self._saved_frames < self.frames:
            self._checkpoint()
        self.progress.update(self.frames, self.learner.updates, self._latest, force=True)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the rest of the training depends on, except the replay buffer."""
        return {
            "learner": self.learner.state_dict(),
            "loop": {
                "frames": self.frames,
                "pending_updates": self.pending_updates,
                "evaluated_frames": self._evaluated_frames,
                "filled_from": self._filled_from,
            },
            "collector": collector_state(self.collector),
            "rng": rng_state(),
            "seconds": dict(self.seconds),
            "threads": torch.get_num_threads(),
        }

    def resume(self, path: Path | str) -> Path:
        """Restore the state of a checkpoint, or of a run's newest one, of the same agent, and return its folder.

        Raises:
            CheckpointError: If there is no checkpoint, it is damaged, or style space or network shapes differ.
        """
        path = find_checkpoint(path)
        state = read_state(path)
        require_same_agent(state, self.describe(), path)
        with refusing(path, "the state of a training"):
            self._restore(state, path / "replay")
        if self.checkpoints and path.parent.resolve() == self.checkpoints.directory.resolve():
            self._saved_frames = self.frames
            self.checkpoints.point_to(path.name)  # before the rows after it are dropped
        self.log.rewind(self.frames)
        return path

    def _restore(self, state: Mapping[str, Any], replay: Path) -> None:
        """Restore what `state_dict` returned; warn and leave the replay buffer empty if none was saved."""
        self.learner.load_state_dict(state["learner"])
        self.frames = int(state["loop"]["frames"])
        self.pending_updates = float(state["loop"]["pending_updates"])
        interval = self.settings.eval_interval  # which may have changed
        self._evaluations = self.frames // interval if interval else 0
        self._evaluated_frames = int(state["loop"].get("evaluated_frames", -1))
        self._filled_from = int(state["loop"]["filled_from"])
        if replay.is_dir():
            read_replay(self.replay, replay)
        else:
            self._filled_from = self.frames
            warnings.warn(
                f"the checkpoint has no replay buffer: updates go on after {self.settings.warmup_frames} new env-steps",
                stacklevel=2,
            )
        self.seconds |= state.get("seconds", {})
        self._logged_frames = self.frames
        self._load_episodes(state["collector"])
        threads = state.get("threads", torch.get_num_threads())
        if threads != torch.get_num_threads():
            warnings.warn(
                f"the checkpoint was written with {threads} torch threads, this run has {torch.get_num_threads()}: "
                "sums are rounded differently, so the training does not continue bit for bit (set threads.learner)",
                stacklevel=2,
            )
        set_rng_state(state["rng"])  # last, because restoring the rest draws random numbers

    def _load_episodes(self, state: dict[str, Any]) -> None:
        try:
            load_collector_state(self.collector, state)
        except UnsavableError as error:
            if isinstance(self.replay, EventTableBuffer):
                self.replay.finish()
            warnings.warn(
                f"the running episodes of {self._environment()} are not restored: {error}. New episodes start, so the "
                "training does not continue bit for bit; everything else that the checkpoint holds is restored",
                stacklevel=4,
            )

    def _environment(self) -> str:
        """Return the environment's name, or the domain's if the environments run in other processes."""
        if isinstance(self.collector, Collector):
            return type(simulation_env(self.collector.env)).__name__
        return str(self.describe().get("domain", "the environment"))

    @contextmanager
    def _timed(self, part: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[part] += time.perf_counter() - start
