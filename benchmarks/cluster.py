"""Costs of collection on Ray, beside the collectors of one process, of several, and TorchRL's own on Ray.

    python benchmarks/cluster.py                              the humanoid, 1, 2, 4 and 8 workers
    python benchmarks/cluster.py --env pendulum --workers 8 --only direct coachable-ray       many small batches

All collectors of one number of workers are started, and measured in turn, in alternating rounds, with the same learner.
Each number is the median over the rounds, and in parentheses is the median of its ratio to that of the collector in
one process in the same round.

`learner's share` is the processor time that the updates would take without a collector, divided by the processor time
of the learner's thread. The rest of that thread goes into taking and storing batches and into offering weights.
`taking` is its processor time for taking and storing 1000 env-steps, which in one process includes the simulation, and
`other threads` are all others of the learner's process, Ray's among them. Other programs hardly change these three.
"""

import argparse
import os
import statistics
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

import recipe_boxes
import torch
from contest import processor
from recipe_config import compose_config

from coachable.cluster import ClusterCollector
from coachable.cluster.connection import Connection
from coachable.cluster.flat_weights import portable_copy
from coachable.code_version import code_version
from coachable.training.collection import make_collector
from coachable.training.trainer import Trainer

ROOT = Path(__file__).resolve().parent.parent
CONTESTANTS = ("direct", "process", "coachable-ray", "torchrl-ray")
NETWORK = ["network.actor.widths=[512,512,512]", "network.critic.widths=[512,512,512]"]
ENVIRONMENTS = {  # each worker sends 64 transitions of the humanoid, or 8 of the pendulum, at a time
    "humanoid": ("humanoid_sac", ["preset=cpu", "env.num_envs=8", *NETWORK]),
    "pendulum": (
        "cheetah_speed",
        ["preset=cpu", "env._target_=cluster_pendulum.pendulum", "~env.seconds", "env.num_envs=1"],
    ),
}
STEPS = 8  # of each environment in a batch
QUICK = ["train.eval_interval=0", "checkpoint.replay=false", "device=cpu", "wandb.mode=off"]
QUICK += [
    "init_random_frames=0",
    "train.warmup_frames=0",
    "replay_capacity=100_000",
    "train.total_frames=1_000_000_000",
]
COLUMNS = {
    "collecting": "env-steps/s without updates",
    "frames": "env-steps/s",
    "updates": "updates/s",
    "share": "learner's share",
    "taking": "taking [ms per 1000]",
    "threads": "other threads [ms per update]",
    "push": "push of weights [ms]",
    "push_cpu": "of the processor",
}

Row = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", choices=ENVIRONMENTS, default="humanoid", help="(%(default)s)")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8], help="(%(default)s)")
    parser.add_argument("--group", type=int, default=8, help="workers of one Ray actor, of coachable-ray (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="(%(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="of each measurement (%(default)s)")
    parser.add_argument("--utd", type=float, default=0.0625, help="updates per env-step (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=CONTESTANTS, default=CONTESTANTS)
    parser.add_argument("--out", type=Path, default=Path("runs/cluster"))
    options = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join(map(str, (ROOT, ROOT / "recipes", ROOT / "benchmarks")))  # of workers
    machine = f"{os.cpu_count()} cores of {processor()}"
    print(f"{options.env}, coachable {code_version()}, {machine}, load {os.getloadavg()[0]:.1f}")
    print("| workers | collector | " + " | ".join(COLUMNS.values()) + " |\n|" + "-|" * (len(COLUMNS) + 2), flush=True)
    connection = Connection(None, 1, 0.1, patience=300.0)  # one Ray for all
    try:
        bench = Bench(options)
        for workers in options.workers:
            for name, row in bench.measure(workers).items():
                print(f"| {workers} | {name} | " + " | ".join(row[column] for column in COLUMNS) + " |", flush=True)
        print(f"load {os.getloadavg()[0]:.1f}")
    finally:
        connection.close()


class Bench:
    """One learner, which is measured with several collectors in turn."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        recipe, arguments = ENVIRONMENTS[options.env]
        arguments = [*arguments, *QUICK, f"train.utd_ratio={options.utd}", "threads.simulator=1", "threads.learner=1"]
        arguments += [f"run_dir={options.out / f'{options.env}_{time.time():.0f}'}"]
        parts: list[Any] = []
        with patch.object(recipe_boxes, "make_collector", lambda run, *made: parts.append((run.settings, *made))):
            self.train: Trainer = import_module(recipe).build(compose_config(recipe, arguments))
        ((settings, self.make_env, self.actor),) = parts
        self.num_envs = settings.env.num_envs
        self.settings = self.train.settings
        self.collecting = type(self.settings)(**{**vars(self.settings), "utd_ratio": 0.0})

    def measure(self, workers: int) -> dict[str, dict[str, str]]:
        """Return the medians of all collectors with a number of workers, and their ratios to those of one process."""
        contestants = [Contestant(name, workers, self) for name in self.options.only]
        rows: dict[str, list[Row]] = {c.name: [] for c in contestants}
        for _ in range(self.options.rounds):
            for contestant in contestants:
                rows[contestant.name].append(contestant.round())
        for contestant in contestants:
            contestant.collector.shutdown()
        return {name: medians(found, rows.get("direct", found)) for name, found in rows.items()}

    def make(self, name: str, workers: int) -> Any:
        """Make a collector; that of one process shares the learner's actor."""
        frames, cores = self.num_envs * workers, 0.4 * (os.cpu_count() or 1) / workers
        if name == "coachable-ray":
            options: dict[str, Any] = {"num_collectors": workers, "steps_per_batch": STEPS, "cpus_per_worker": cores}
            options |= {"group_size": self.options.group, "queue_size": workers}
            return ClusterCollector(self.make_env, self.actor, frames_per_batch=frames, **options)
        if name == "torchrl-ray":
            return torchrl_ray(self.make_env, portable_copy(self.actor), self.num_envs * STEPS, workers, cores)
        if name == "process":
            options = {"frames_per_batch": frames * STEPS, "backend": "process", "num_collectors": workers}
            return make_collector(self.make_env, portable_copy(self.actor), **options)
        return make_collector(self.make_env, self.actor, frames_per_batch=self.num_envs * STEPS)


class Contestant:
    """A collector with its workers, which rest between the rounds."""

    def __init__(self, name: str, workers: int, bench: Bench) -> None:
        self.name, self.workers, self.bench, self.train = name, workers, bench, bench.train
        self.collector = bench.make(name, workers)
        self.batches = iter(self.collector)
        self.train.collector, self.train.settings = self.collector, bench.collecting
        for _ in range(2 * workers):  # all have started
            self._step()

    def round(self) -> Row:
        """Return what is measured in one round."""
        train, seconds = self.train, self.bench.options.seconds
        alone = self._update_alone()
        self._wake()
        train.settings = self.bench.collecting
        collecting = self._rates(seconds)
        train.settings = self.bench.settings
        learning = self._rates(seconds)
        pushes = [] if self.name == "direct" else [self._push() for _ in range(5)]
        self._rest()
        row = {"collecting": collecting["frames"], "frames": learning["frames"], "updates": learning["updates"]}
        row |= {"share": alone / learning["thread"], "taking": learning["taking"], "threads": learning["threads"]}
        if pushes:
            row |= {"push": statistics.median(wall for wall, _ in pushes)}
            row |= {"push_cpu": statistics.median(cpu for _, cpu in pushes)}
        return row

    def _update_alone(self) -> float:
        """Return the seconds of the processor that an update takes while no collector is used."""
        self.train.collector = None  # pyright: ignore[reportAttributeAccessIssue]
        began = time.thread_time()
        for _ in range(20):
            self.train._update_once()
        self.train.collector = self.collector
        return (time.thread_time() - began) / 20

    def _step(self) -> float:
        """Return the seconds of the processor that taking and storing took."""
        began = time.thread_time()
        data = self.train._collect(self.batches)
        self.train._store(data)
        taken = time.thread_time() - began
        self.train._update(data.numel(), threading.Event())
        return taken

    def _rates(self, seconds: float) -> Row:
        train = self.train
        frames, updates, taking = train.frames, train.learner.updates, 0.0
        began, thread, process = time.perf_counter(), time.thread_time(), time.process_time()
        while (wall := time.perf_counter() - began) < seconds or train.frames == frames:
            taking += self._step()
        thread = time.thread_time() - thread
        frames, updates = train.frames - frames, train.learner.updates - updates
        others = time.process_time() - process - thread
        row = {"frames": frames / wall, "updates": updates / wall, "taking": 1e6 * taking / frames}
        return row | {"thread": thread / max(updates, 1), "threads": 1e3 * others / max(updates, 1)}

    def _wake(self) -> None:
        """Let workers go on, and take what they had ready and one more batch of each, so that all are busy."""
        if self.name == "coachable-ray":
            while self.collector.has_batch():
                next(self.batches)
            self.collector.workers.queue_size = self.workers
        if self.name in ("coachable-ray", "torchrl-ray"):
            wanted = self.workers if self.name == "coachable-ray" else 2 * self.workers
            while wanted > 0:
                wanted -= next(self.batches).numel() // (STEPS * self.bench.num_envs)

    def _rest(self) -> None:
        if self.name == "coachable-ray":
            self.collector.workers.queue_size = 0

    def _push(self) -> tuple[float, float]:
        """Send the weights, with coachable-ray to the object store; return the time and the processor's time [ms]."""
        collector, began, thread = self.collector, time.perf_counter(), time.thread_time()
        if isinstance(collector, ClusterCollector):
            collector.after_update(collector._updates + collector.weights_every)
            collector.workers._stored_weights()
        else:
            collector.update_policy_weights_()
        return 1e3 * (time.perf_counter() - began), 1e3 * (time.thread_time() - thread)


def torchrl_ray(make_env: Callable[[int], Any], actor: torch.nn.Module, frames: int, workers: int, cores: float) -> Any:
    """Make TorchRL's own collector on the Ray of this process; each of its batches is from one worker."""
    from torchrl.collectors import Collector

    collector: Any = Collector(
        [partial(make_env, seed) for seed in range(workers)],
        actor,
        backend="ray",
        num_collectors=workers,
        sync=False,
        frames_per_batch=frames,
        total_frames=sys.maxsize,
        collector_kwargs=[{"auto_register_policy_transforms": False} for _ in range(workers)],
        remote_configs={"num_cpus": cores, "num_gpus": 0, "memory": 2**20},
    )
    collector.update_policy_weights_(actor)
    return collector


def medians(rows: list[Row], reference: list[Row]) -> dict[str, str]:
    """Return the median of each column, and the median of its ratio to that of the reference in the same round."""
    cells = dict.fromkeys(COLUMNS, "")
    for column in rows[0]:
        values = [row[column] for row in rows]
        cells[column] = f"{statistics.median(values):.3g}"
        if reference is not rows and column in ("collecting", "frames", "updates"):
            ratios = [row[column] / other[column] for row, other in zip(rows, reference, strict=True)]
            cells[column] += f" ({statistics.median(ratios):.2f})"
    return cells


if __name__ == "__main__":
    main()
