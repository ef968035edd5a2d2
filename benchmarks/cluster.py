"""Costs of collection on Ray, beside the collectors of one process, of several, and TorchRL's own on Ray.

python benchmarks/cluster.py                              1, 2, 4 and 8 workers
python benchmarks/cluster.py --workers 8 --group 8        workers of one group share the memory of Python and torch
"""

import argparse
import os
import statistics
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

from recipe_config import compose_config

from coachable.training.trainer import Trainer

CONTESTANTS = ("direct", "process", "coachable-ray", "torchrl-ray")
NETWORK = ["network.actor.widths=[512,512,512]", "network.critic.widths=[512,512,512]"]
QUICK = ["train.eval_interval=0", "checkpoint.replay=false", "device=cpu", "wandb.mode=off"]
QUICK += [
    "init_random_frames=0",
    "train.warmup_frames=0",
    "replay_capacity=100_000",
    "train.total_frames=1_000_000_000",
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8], help="(%(default)s)")
    parser.add_argument("--group", type=int, default=1, help="workers of one Ray actor, of coachable-ray (%(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=CONTESTANTS, default=CONTESTANTS)
    parser.add_argument("--out", type=Path, default=Path("runs/cluster"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    measure_costs(options)


def measure_costs(options: argparse.Namespace) -> None:
    print(f"load before: {os.getloadavg()[0]:.1f}")
    names = ("env-steps/s without updates", "env-steps/s", "updates/s", "push of weights [ms]", "next batch [ms]")
    print("| workers | collector | " + " | ".join(names) + " |\n|" + "-|" * 7)
    for workers in options.workers:
        for name in options.only:
            if name == "direct" and workers > 1:
                continue
            row = measure(name, workers, options)
            print(f"| {workers} | {name} | " + " | ".join(row) + " |", flush=True)


def measure(name: str, workers: int, options: argparse.Namespace) -> list[str]:
    """Returns rates without and with updates, and the times of one push of weights and of one batch."""
    train, seconds = make_training(name, workers, options), options.seconds
    batches = iter(train.collector)
    for _ in range(2):
        _step(train, batches)
    plain, _ = _rates(train, batches, seconds)
    take = _median_ms(lambda: next(batches), 20)
    train.settings = type(train.settings)(**{**vars(train.settings), "utd_ratio": 0.125})
    learning, updates = _rates(train, batches, seconds)
    push = "" if name == "direct" else f"{_median_ms(lambda: _push(train), 20):.1f}"
    train.collector.shutdown()
    return [f"{plain:.0f}", f"{learning:.0f}", f"{updates:.1f}", push, f"{take:.1f}"]


def make_training(name: str, workers: int, options: argparse.Namespace) -> Trainer:
    """Makes a humanoid training whose workers have 8 environments each and send 64 transitions at a time."""
    group = {"coachable-ray": "ray", "torchrl-ray": "direct"}.get(name, name)
    arguments = [*NETWORK, *QUICK, "preset=cpu", f"collector={group}", "env.num_envs=8", "train.utd_ratio=0"]
    if group != "direct":
        arguments.append(f"collector.num_collectors={workers}")
    if group == "ray":
        arguments += [f"collector.cpus_per_worker={_cores(workers)}", f"collector.group_size={options.group}"]
    arguments += [
        "threads.simulator=1",
        "threads.learner=1",
        f"run_dir={options.out / f'{name}_{workers}_{time.time():.0f}'}",
    ]
    from humanoid_sac import build

    train = build(compose_config("humanoid_sac", arguments))
    if name == "torchrl-ray":
        env, train.collector = train.collector, None
        train.collector = _torchrl_ray(train, workers)
        env.shutdown()
    return train


def _torchrl_ray(train: Trainer, workers: int) -> Any:
    """Makes TorchRL's own collector on Ray, each of whose batches is 64 transitions of one worker."""
    from torchrl.collectors import Collector

    from coachable.cluster.connection import Connection

    Connection(None, workers, _cores(workers), patience=300.0)  # ends with this process or the collector
    actor = train.learner.loss_module.actor_network
    factories = [HumanoidFactory(seed) for seed in range(workers)]
    collector: Any = Collector(
        factories,
        actor,
        backend="ray",
        num_collectors=workers,
        sync=False,
        frames_per_batch=64,
        total_frames=sys.maxsize,
        collector_kwargs=[{"auto_register_policy_transforms": False} for _ in factories],
        remote_configs={"num_cpus": _cores(workers), "num_gpus": 0, "memory": 2**20},
    )
    collector.update_policy_weights_(actor)
    return collector


class HumanoidFactory:
    """Function without arguments that makes the environment of the humanoid recipe."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __call__(self) -> Any:
        from coachable.domains.humanoid import humanoid_style_reward, humanoid_style_space
        from coachable.envs.humanoid import HumanoidEnv
        from coachable.training.episodes import EpisodeSums
        from coachable.transforms import coachable_env

        space = humanoid_style_space()
        env = HumanoidEnv(num_envs=8, seed=self.seed, num_threads=1)
        return coachable_env(env, space, humanoid_style_reward(space), EpisodeSums(), seed=self.seed)


def _cores(workers: int) -> float:
    return min(1.0, (os.cpu_count() or 1) / workers)


def _step(train: Trainer, batches: Any) -> None:
    data = train._collect(batches)
    train._store(data)
    train._update(data.numel(), threading.Event())


def _rates(train: Trainer, batches: Any, seconds: float) -> tuple[float, float]:
    frames, updates, start = train.frames, train.learner.updates, time.perf_counter()
    while (wall := time.perf_counter() - start) < seconds:
        _step(train, batches)
    return (train.frames - frames) / wall, (train.learner.updates - updates) / wall


def _push(train: Trainer) -> None:
    """Sends the weights: to the workers, or with `coachable-ray` to the object store, from which they fetch them."""
    if hasattr(train.collector, "after_update"):
        train.collector.after_update(train.collector._updates + train.collector.weights_every)
        train.collector.workers._stored_weights()
    else:
        train.collector.update_policy_weights_()


def _median_ms(function: Callable[[], Any], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1e3


if __name__ == "__main__":
    main()
