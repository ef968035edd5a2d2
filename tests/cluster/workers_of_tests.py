"""Environments that fail in one worker, and trainings on them, for tests of collection on Ray."""

import os
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch

from coachable.cluster import ClusterCollector
from coachable.replay import EventTableBuffer, PredicateEvents
from coachable.styles import StyleReward, Term
from coachable.training.episodes import EpisodeSums
from coachable.training.trainer import Trainer, replay_keys
from coachable.transforms import coachable_env
from tests.echo import StyleEchoEnv, echo_space, make_train

NUM_ENVS = 2
STEPS = 5
N_STEPS = 3


class FaultyEnv(StyleEchoEnv):
    """In the worker that creates the file `claim` first, or in all workers once `all_fail` exists, steps go wrong.

    With the fault "start" no environment is ever made; each worker writes its process into a file `started_*` first.
    """

    def __init__(self, folder: Path, fault: str, seed: int) -> None:
        super().__init__(NUM_ENVS, seed)
        if fault == "start":
            (folder / f"started_{os.getpid()}").touch()
            time.sleep(1000.0)
        self.folder, self.fault, self.is_faulty = folder, fault, False

    def _claims(self) -> bool:
        try:
            os.close(os.open(self.folder / "claim", os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return False
        return True

    def _step(self, tensordict):
        if self.steps == STEPS + 1:  # in the second batch
            self.is_faulty = self.fault in ("raise", "hang", "slow") and self._claims()
        if self.fault == "raise always" or (self.is_faulty and self.fault == "raise"):
            raise ZeroDivisionError("the pole has no length")
        if self.fault == "all" and (self.folder / "all_fail").exists():
            raise ZeroDivisionError("the pole has no length")
        if self.is_faulty:
            time.sleep(1000.0 if self.fault == "hang" else 1.0)
        time.sleep(0.01)
        return super()._step(tensordict)


def faulty_env(folder: Path, fault: str, seed: int) -> Any:
    term = Term(lambda features, style: features[..., 0], parameters=("target",))
    reward = StyleReward(echo_space(), {"target": term})
    return coachable_env(FaultyEnv(folder, fault, seed), echo_space(), reward, EpisodeSums(), seed=seed)


def far(steps):
    return steps["next", "observation"][..., 0].abs() > 1.0


def cluster_train(folder: Path, fault: str = "", workers: int = 2, **settings: Any) -> Trainer:
    """A training with event tables and n-step sums; `settings` are those of the collector and of the loop."""
    own = {"patience": 600.0, "queue_size": 4}
    own |= {name: settings.pop(name) for name in (*own, "address", "cpus_per_worker", "group_size") if name in settings}
    defaults: dict[str, Any] = {"total_frames": 400, "utd_ratio": 0.1, "log_interval": 0.0, "warmup_frames": 20}
    train = make_train(folder / "run", **{**defaults, **settings})
    example = train.collector.env
    train.replay = EventTableBuffer(
        {"default": 5000, "far": 500}, events=PredicateEvents({"far": far}), event_horizon=4, n_steps=N_STEPS, gamma=0.9
    )
    train.replay_keys = replay_keys(example, tables=True)
    train.collector.shutdown()
    actor = train.learner.loss_module.actor_network
    make_env = partial(faulty_env, folder, fault)
    frames = workers * NUM_ENVS
    train.collector = ClusterCollector(
        make_env, actor, frames_per_batch=frames, num_collectors=workers, steps_per_batch=STEPS, **own
    )
    return train


class Watch:
    """What arrives at a training, by the workers' batches; `visit` is called after one or more of them are stored."""

    def __init__(self, train: Trainer, visit=lambda watch: None) -> None:
        self.train, self.batches = train, []
        store = train._store

        def keep(data):
            self.batches += [batch.contiguous().clone() for batch in data.split(NUM_ENVS)]
            store(data)
            visit(self)

        train._store = keep

    def numbers(self, name: str) -> list[int]:
        return [int(data["collector", name][0, 0]) for data in self.batches]

    def serials(self) -> dict[tuple[int, int], list[int]]:
        """Serial numbers by worker and restart, in the order of arrival."""
        found: dict[tuple[int, int], list[int]] = {}
        columns = zip(self.numbers("worker"), self.numbers("restart"), self.numbers("serial"), strict=True)
        for worker, restart, serial in columns:
            found.setdefault((worker, restart), []).append(serial)
        return found

    def require_nothing_lost(self) -> None:
        """Every batch that a worker sent has arrived once and in order, and every step of it is stored once."""
        for worker, serials in self.serials().items():
            assert serials == list(range(len(serials))), worker
        owners: dict[int, tuple[int, int]] = {}
        for data, worker, restart in zip(self.batches, self.numbers("worker"), self.numbers("restart"), strict=True):
            for number in data["collector", "traj_ids"].unique().tolist():
                assert owners.setdefault(number, (worker, restart)) == (worker, restart)
        replay = self.train.replay
        arrived = sum(data.numel() for data in self.batches)
        waiting = replay._writer.n_step._data  # for the rest of their sum
        held = 0 if waiting is None else len(waiting)
        assert arrived == self.train.frames == replay.write_count + held
        assert held <= (N_STEPS - 1) * NUM_ENVS * len(self.train.collector.workers.slots), (
            "steps of the lost are written"
        )

    def require_sums_within_trajectories(self) -> None:
        """The sum of each stored transition has the rewards of its own trajectory, up to its end or interruption."""
        flat = torch.cat([data.transpose(0, 1).reshape(-1) for data in self.batches])
        rewards = {}
        for number, reward in zip(
            flat["collector", "traj_ids"].tolist(), flat["next", "reward"].flatten().tolist(), strict=True
        ):
            rewards.setdefault(number, []).append(reward)
        stored = self.train.replay.table("default")
        seen: dict[int, int] = {}
        for row in range(len(stored)):
            number = int(stored["collector", "traj_ids"][row])
            at = seen[number] = seen.get(number, -1) + 1
            expected = sum(0.9**k * r for k, r in enumerate(rewards[number][at : at + N_STEPS]))
            assert abs(float(stored["next", "reward"][row]) - expected) < 1e-4
