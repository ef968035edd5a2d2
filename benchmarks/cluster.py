"""Collection on Ray: its costs, a fleet of slow workers that die, and learning from it.

    python benchmarks/cluster.py                              costs beside the other collectors, 1, 2, 4 and 8 workers
    python benchmarks/cluster.py --fleet --minutes 10         100 workers at 5 Hz x 1 environment, ten killed per minute
    python benchmarks/cluster.py --learning                   combat, preset small: local, 8 workers, and stale weights

`--fleet` trains on the humanoid, on fights and on Gymnasium's pendulum; `--only` chooses. A worker takes some 300 MB of
memory: `--workers 20` fits into 8 GB. Tables are printed, and with figures written to `--out`.
"""

import argparse
import itertools
import os
import random
import signal
import statistics
import sys
import threading
import time
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

from matplotlib import pyplot as plt
from recipe_config import compose_config

from coachable.evaluation.curves import read_metric
from coachable.evaluation.many_seeds import train_seeds
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
FLEET = {
    "humanoid": ("humanoid_sac", ["preset=cpu"]),
    "combat": ("combat_cat_rac", ["preset=small"]),
    "pendulum": ("cheetah_speed", ["preset=cpu", "env._target_=cluster_pendulum.pendulum", "~env.seconds"]),
}
RATE = 5.0  # [env-steps/s] of a worker, as a game console gives them


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--fleet", action="store_true")
    mode.add_argument("--learning", action="store_true")
    parser.add_argument("--workers", type=int, nargs="+", help="1 2 4 8; of the fleet: 100")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement of costs (%(default)s)")
    parser.add_argument("--minutes", type=float, default=10.0, help="of each fleet, from when all work (%(default)s)")
    parser.add_argument("--kills", type=float, default=10.0, help="workers per minute (%(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the learning check (%(default)s)")
    parser.add_argument("--only", nargs="+", help=f"of {', '.join(CONTESTANTS)}; of the fleet {', '.join(FLEET)}")
    parser.add_argument("--out", type=Path, default=Path("runs/cluster"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.learning:
        check_learning(options)
    elif options.fleet:
        run_fleets(options)
    else:
        measure_costs(options)


# Costs


def measure_costs(options: argparse.Namespace) -> None:
    names = ("env-steps/s without updates", "env-steps/s", "updates/s", "push of weights [ms]", "next batch [ms]")
    print("| workers | collector | " + " | ".join(names) + " |\n|" + "-|" * 7)
    for workers in options.workers or (1, 2, 4, 8):
        for name in options.only or CONTESTANTS:
            if name == "direct" and workers > 1:
                continue
            row = measure(name, workers, options.seconds, options.out)
            print(f"| {workers} | {name} | " + " | ".join(row) + " |", flush=True)


def measure(name: str, workers: int, seconds: float, out: Path) -> list[str]:
    """Returns rates without and with updates, and the times of one push of weights and of one batch."""
    train = make_training(name, workers, out)
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


def make_training(name: str, workers: int, out: Path) -> Trainer:
    """Makes a humanoid training whose workers have 8 environments each and send 64 transitions at a time."""
    group = {"coachable-ray": "ray", "torchrl-ray": "direct"}.get(name, name)
    arguments = [*NETWORK, *QUICK, "preset=cpu", f"collector={group}", "env.num_envs=8", "train.utd_ratio=0"]
    if group != "direct":
        arguments.append(f"collector.num_collectors={workers}")
    if group == "ray":
        arguments.append(f"collector.cpus_per_worker={_cores(workers)}")
    arguments += ["threads.simulator=1", "threads.learner=1", f"run_dir={out / f'{name}_{workers}_{time.time():.0f}'}"]
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


# Fleet


def run_fleets(options: argparse.Namespace) -> None:
    count = (options.workers or [100])[0]
    warnings.filterwarnings("ignore", "a Ray worker was lost")
    asked = count * RATE
    print(f"{count} workers at {RATE:g} env-steps/s, {options.kills:g} killed per minute, {options.minutes:g} minutes")
    names = ("env-steps/s asked", "reached", "staleness [updates]", "largest", "learner's share", "updates/s")
    print("| environment | " + " | ".join((*names, "MB per worker", "queue", "restarts", "alive")) + " |")
    print("|" + "-|" * 11)
    for name in options.only or FLEET:
        rows, megabytes = run_fleet(name, count, options)
        first, last = rows[0], rows[-1]
        wall = last["time"] - first["time"]
        mean = {key: statistics.mean(row[key] for row in rows[1:]) for key in rows[0]}
        cells = [f"{asked:.0f}", f"{(last['frames'] - first['frames']) / wall:.0f}", f"{mean['workers/staleness']:.1f}"]
        cells += [f"{max(row['workers/staleness_max'] for row in rows[1:]):.0f}"]
        cells += [f"{(last['seconds/update'] - first['seconds/update']) / wall:.0%}"]
        cells += [
            f"{(last['updates'] - first['updates']) / wall:.1f}",
            f"{megabytes:.0f}",
            f"{mean['workers/queue']:.1f}",
        ]
        cells += [f"{last['workers/restarts'] - first['workers/restarts']:.0f}", f"{mean['workers/alive']:.0f}"]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
        draw(rows, asked, f"{name}, {count} workers", options.out / f"fleet_{name}.png")


def run_fleet(name: str, count: int, options: argparse.Namespace) -> tuple[list[dict[str, float]], float]:
    """Returns the rows of the log from when all workers work, and the memory of a worker [MB]."""
    recipe, arguments = FLEET[name]
    run_dir = options.out / f"fleet_{name}_{time.time():.0f}"
    arguments = [*arguments, *QUICK, "collector=ray", f"collector.num_collectors={count}", "env.num_envs=1"]
    arguments += [f"collector.worker_throttle={RATE}", f"collector.cpus_per_worker={1 / count}"]
    arguments += ["collector.steps_per_batch=8", "train.utd_ratio=null", f"train.throttle={2 * RATE * count}"]
    arguments += ["train.log_interval=2", "train.checkpoint_interval=1e9", "threads.simulator=1", "threads.learner=1"]
    train = import_module(recipe).build(compose_config(recipe, [*arguments, f"run_dir={run_dir}"]))
    workers = train.collector.workers
    rows: list[dict[str, float]] = []
    memory: list[float] = []
    dies = random.Random(0)
    began = next_kill = 0.0
    write = train._write

    def observe(row: dict[str, float]) -> None:
        nonlocal began, next_kill
        write(row)
        now = time.monotonic()
        if not began and workers.alive() < count:
            return
        if not began:
            began, next_kill = now, now + 60.0 / options.kills
            memory.extend(_private_bytes(slot.pid) / 1e6 for slot in workers.slots)
        rows.append({"time": now, **row})
        while now >= next_kill:
            next_kill += 60.0 / options.kills
            ready = [slot.pid for slot in workers.slots if slot.is_ready]
            if ready:
                os.kill(dies.choice(ready), signal.SIGKILL)
        if now - began > options.minutes * 60.0:
            train.settings = type(train.settings)(total_frames=1)

    train._write = observe
    train.run()
    return [row for row in rows if "workers/queue" in row], statistics.mean(memory)


def _private_bytes(pid: int) -> int:
    """Returns the memory that a process shares with no other."""
    rows = (line.split() for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return sum(int(row[1]) * 1024 for row in rows if row[0].startswith("Private_"))


def draw(rows: list[dict[str, float]], asked: float, title: str, file: Path) -> None:
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7, 5), layout="constrained")
    minutes = [(row["time"] - rows[0]["time"]) / 60 for row in rows]
    pairs = list(itertools.pairwise(rows))
    above.plot(minutes[1:], [(b["frames"] - a["frames"]) / (b["time"] - a["time"]) for a, b in pairs], label="reached")
    above.axhline(asked, color="gray", linestyle="--", label="asked")
    above.set(ylabel="env-steps/s", title=title, ylim=(0, None))
    above.legend()
    below.plot(minutes, [row["workers/staleness"] for row in rows], label="staleness [updates]")
    below.plot(minutes, [row["workers/alive"] for row in rows], label="workers alive")
    below.set(xlabel="minutes", ylim=(0, None))
    below.legend()
    figure.savefig(file, dpi=120)
    plt.close(figure)


# Learning


def check_learning(options: argparse.Namespace) -> None:
    """Trains where the weights come from, at equal env-steps and updates, and prints what is reached."""
    eight = ["collector=ray", "collector.num_collectors=8", "env.num_envs=16", "collector.cpus_per_worker=0.25"]
    variants = {"local": [], "8 workers": eight}
    variants |= {f"every {n} updates": [*eight, f"collector.weights_every={n}"] for n in (10, 100, 1000)}
    print("| weights | seed | return | staleness [updates] | env-steps | updates |\n|-|-|-|-|-|-|")
    for name, arguments in variants.items():
        folder = options.out / f"learning_{name.replace(' ', '_')}"
        recipe = Path(__file__).resolve().parent.parent / "recipes" / "combat_cat_rac.py"
        if failed := train_seeds(recipe, ["preset=small", *arguments], options.seeds, folder):
            sys.exit(f"{name}: {failed}")
        for seed in options.seeds:
            last = {
                metric: read_metric(folder / f"seed_{seed}", "frames", metric)[1]
                for metric in ("frames", "updates", "eval/return", *(["workers/staleness"] if arguments else []))
            }
            stale = last["workers/staleness"].mean() if arguments else 0.0
            cells = [name, f"{seed}", f"{last['eval/return'][-1]:.1f}", f"{stale:.0f}"]
            cells += [f"{last[metric][-1]:.0f}" for metric in ("frames", "updates")]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
