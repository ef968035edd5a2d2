"""A fleet of slow workers on Ray, some of which are killed all the time, as a table and plots.

    python benchmarks/cluster_fleet.py                                  100 workers, half an hour per environment
    python benchmarks/cluster_fleet.py --workers 25 --minutes 3 --only pendulum

Each worker is held to 5 env-steps/s, as a game console is, and the learner updates all the time, on a core of its own
if there are several: in the paper it has a machine of its own. The workers share the other cores. Measured are the
humanoid, a fight and Gymnasium's pendulum, from when all workers work. What was measured is written to `--out`; an
environment that has been measured to its end is not measured again, so that the same command continues after an
interruption.

The machine is not driven out of memory: workers are started one after the other, and the measurement ends with an
error as soon as less than `--reserve` GB are left.
"""

import argparse
import csv
import itertools
import os
import random
import signal
import statistics
import sys
import threading
import time
import warnings
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "recipes"))

import matplotlib

matplotlib.use("Agg")
from cluster import QUICK
from contest import cpu_seconds
from matplotlib import pyplot as plt
from recipe_config import compose_config

ENVIRONMENTS = {
    "humanoid": ("humanoid_sac", ["preset=cpu"]),
    "combat": ("combat_cat_rac", ["preset=small"]),
    "pendulum": ("cheetah_speed", ["preset=cpu", "env._target_=cluster_pendulum.pendulum", "~env.seconds"]),
}
SLOW = ["train.utd_ratio=null", "train.log_interval=1", "train.checkpoint_interval=1e9", "env.num_envs=1"]
SLOW += ["threads.simulator=1", "threads.learner=1"]
HEADINGS = (
    "environment",
    "env-steps/s asked",
    "reached",
    "staleness [updates]",
    "largest",
    "learner's share",
    "updates/s",
)
HEADINGS += ("MB per worker", "its own", "cores of the workers", "queue", "killed", "restarts", "alive", "load")

Row = dict[str, float]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=100, help="number of workers (%(default)s)")
    parser.add_argument("--group", type=int, default=25, help="workers that share their memory (%(default)s)")
    parser.add_argument("--rate", type=float, default=5.0, help="of each worker [env-steps/s] (%(default)s)")
    parser.add_argument("--minutes", type=float, default=30.0, help="of each environment (%(default)s)")
    parser.add_argument("--kills", type=float, default=10.0, help="workers per minute (%(default)s)")
    parser.add_argument("--reserve", type=float, default=6.0, help="memory that stays free [GB] (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=ENVIRONMENTS, default=list(ENVIRONMENTS))
    parser.add_argument("--out", type=Path, default=Path("runs/fleet"))
    options = parser.parse_args()
    options.cores = os.sched_getaffinity(0)
    options.out.mkdir(parents=True, exist_ok=True)
    warnings.filterwarnings("ignore", "a Ray worker was lost")
    asked = options.workers * options.rate
    print(
        f"{options.workers} workers at {options.rate:g} env-steps/s in groups of {options.group}, "
        f"{options.kills:g} killed per minute, {options.minutes:g} minutes"
    )
    print("| " + " | ".join(HEADINGS) + " |\n|" + "-|" * len(HEADINGS), flush=True)
    for name in options.only:
        file = options.out / f"{name}_{options.workers}_workers_{options.minutes:g}_minutes.csv"
        if not file.exists():
            write_rows(file, Fleet(name, options).run())
        rows = read_rows(file)
        print("| " + " | ".join([name, *cells(rows, asked)]) + " |", flush=True)
        draw(rows, asked, f"{name}, {options.workers} workers", file.with_suffix(".png"))


class Fleet:
    """Training on many slow workers, which observes itself and kills some of them."""

    def __init__(self, name: str, options: argparse.Namespace) -> None:
        recipe, arguments = ENVIRONMENTS[name]
        learner = {min(options.cores)}
        others = options.cores - learner or options.cores
        share = min(1.0, len(others) / (2 * options.workers))
        arguments = [*arguments, *QUICK, *SLOW, "collector=ray", f"collector.num_collectors={options.workers}"]
        arguments += [f"collector.group_size={options.group}", f"collector.worker_throttle={options.rate}"]
        arguments += [f"collector.cpus_per_worker={share}", "collector.steps_per_batch=8"]
        arguments += [f"train.throttle={2 * options.rate * options.workers}"]  # more than the workers give
        arguments += [f"run_dir={options.out / f'{name}_{time.time():.0f}'}"]
        self.options = options
        os.sched_setaffinity(0, others)  # Ray starts in here, and its processes inherit it
        self.train = import_module(recipe).build(compose_config(recipe, arguments))
        os.sched_setaffinity(0, learner)
        self.workers = self.train.collector.workers
        self.rows: list[Row] = []
        self.began = self.next_kill = 0.0
        self.killed = 0
        self.seen: dict[int, tuple[float, float]] = {}  # time and processor time of a worker when it was first seen [s]
        self.dies = random.Random(0)
        self._write = self.train._write
        self.train._write = self._observe

    def run(self) -> list[Row]:
        """Return the rows of the log from when all workers worked; the last one has what is measured once."""
        threading.Thread(target=self._wait_for_all, args=(self.workers.queue_size,), daemon=True).start()
        self.workers.queue_size = 0  # workers that have started wait for the others
        self.train.run()
        if self._last_row().get("done") != 1.0:
            sys.exit("the measurement was interrupted: the same command starts this environment again")
        return self.rows

    def _wait_for_all(self, queue_size: int) -> None:
        alive = -1
        while alive < self.options.workers:
            time.sleep(1.0)
            if (free := memory_left()) < self.options.reserve:
                self.workers.error = MemoryError(f"only {free:.1f} GB of memory are left with {alive} workers")
                return
            if alive // 10 < self.workers.alive() // 10:
                print(f"{self.workers.alive()} workers have started, {free:.1f} GB left", file=sys.stderr, flush=True)
            alive = self.workers.alive()
        self.workers.queue_size = queue_size

    def _last_row(self) -> Row:
        return self.rows[-1] if self.rows else {}

    def _observe(self, row: Row) -> None:
        self._write(row)
        now = time.monotonic()
        if (free := memory_left()) < self.options.reserve:
            self._end()
            print(f"only {free:.1f} GB of memory are left", file=sys.stderr)
            return
        if "workers/queue" not in row or self._last_row().get("done"):
            return
        if not self.began:
            self.began, self.next_kill = now, now + 60.0 / self.options.kills
        for slot in self.workers.slots:
            if slot.is_ready and slot.pid not in self.seen:
                self.seen[slot.pid] = now, cpu_seconds(slot.pid)
        kept = {"frames": self.train.frames, "updates": self.train.learner.updates}
        kept |= {key: value for key, value in row.items() if key == "seconds/update" or key.startswith("workers/")}
        self.rows.append({"time": now - self.began, **kept, "killed": self.killed, "load": os.getloadavg()[0]})
        if now - self.began > self.options.minutes * 60.0:
            self.rows[-1] |= {**self._memory(), "cores": self._cores(now), "done": 1.0}
            self._end()
        while now >= self.next_kill:
            self.next_kill += 60.0 / self.options.kills
            self._kill_one()

    def _end(self) -> None:
        self.train.settings = type(self.train.settings)(total_frames=1)

    def _kill_one(self) -> None:
        ready = [slot.pid for slot in self.workers.slots if slot.is_ready]
        if ready:
            os.kill(self.dies.choice(ready), signal.SIGKILL)
            self.killed += 1

    def _memory(self) -> Row:
        """Return the memory per worker of everything that Ray runs, and the part that one has for itself [MB]."""
        own = [memory(slot.pid) for slot in self.workers.slots if slot.is_ready]
        everything = sum(memory(pid)["Pss"] for pid in descendants(os.getpid()))
        private = statistics.mean(part["Private_Clean"] + part["Private_Dirty"] for part in own if part["Pss"])
        return {"megabytes": everything / self.options.workers / 1e6, "private megabytes": private / 1e6}

    def _cores(self, now: float) -> float:
        """Return the number of cores that as many workers use as are asked for, from those that are alive."""
        alive = [slot.pid for slot in self.workers.slots if slot.is_ready and slot.pid in self.seen]
        spans = [(self.seen[pid], cpu_seconds(pid)) for pid in alive]
        used = sum(cpu - began for (_, began), cpu in spans)
        return used / sum(now - since for (since, _), _ in spans) * self.options.workers


def memory_left() -> float:
    """Return the memory that new processes can have [GB]."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) / 1e6


def memory(pid: int) -> dict[str, int]:
    """Return the memory of a process by kind [bytes]: `Pss` counts a page that n processes share as 1/n of one."""
    found = dict.fromkeys(("Pss", "Private_Clean", "Private_Dirty"), 0)
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    except OSError:  # it has just ended
        return found
    return found | {line.split(":")[0]: int(line.split()[1]) * 1024 for line in lines}


def descendants(pid: int) -> Iterable[int]:
    """Yield the processes that a process and those below it have started."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    below = {pid}
    while found := {child for child, parent in parents.items() if parent in below} - below:
        yield from found
        below |= found


def write_rows(file: Path, rows: list[Row]) -> None:
    with file.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, list(rows[-1]))
        writer.writeheader()
        writer.writerows(rows)


def read_rows(file: Path) -> list[Row]:
    with file.open(newline="") as opened:
        return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(opened)]


def cells(rows: list[Row], asked: float) -> list[str]:
    first, last, later = rows[0], rows[-1], rows[1:]
    wall = last["time"] - first["time"]
    rate = {key: (last[key] - first[key]) / wall for key in ("frames", "updates", "seconds/update")}
    mean = {key: statistics.mean(row[key] for row in later) for key in first}
    return [
        f"{asked:.0f}",
        f"{rate['frames']:.0f}",
        f"{mean['workers/staleness']:.1f}",
        f"{max(row['workers/staleness_max'] for row in later):.0f}",
        f"{rate['seconds/update']:.0%}",
        f"{rate['updates']:.1f}",
        f"{last['megabytes']:.0f}",
        f"{last['private megabytes']:.0f}",
        f"{last['cores']:.2f}",
        f"{mean['workers/queue']:.1f}",
        f"{last['killed']:.0f}",
        f"{last['workers/restarts'] - first['workers/restarts']:.0f}",
        f"{mean['workers/alive']:.0f}",
        f"{mean['load']:.1f}",
    ]


def draw(rows: list[Row], asked: float, title: str, file: Path) -> None:
    figure, (above, middle, below) = plt.subplots(3, 1, sharex=True, figsize=(7, 6.5), layout="constrained")
    minutes = [row["time"] / 60 for row in rows]
    every = max(1, len(rows) // 60)  # single rows have no or several batches of a worker
    pairs = list(itertools.pairwise(rows[::every]))
    rates = [(b["frames"] - a["frames"]) / (b["time"] - a["time"]) for a, b in pairs]
    above.plot([b["time"] / 60 for _, b in pairs], rates, label="reached")
    above.axhline(asked, color="gray", linestyle="--", label="asked")
    above.set(ylabel="env-steps/s", title=title, ylim=(0, None))
    middle.plot(minutes, [row["workers/staleness"] for row in rows], label="mean")
    middle.plot(minutes, [row["workers/staleness_max"] for row in rows], label="largest")
    middle.set(ylabel="staleness [updates]", ylim=(0, None))
    below.plot(minutes, [row["workers/alive"] for row in rows], label="alive")
    below.plot(minutes, [row["workers/restarts"] for row in rows], label="restarts so far")
    below.set(xlabel="minutes", ylabel="workers", ylim=(0, None))
    for axes in (above, middle, below):
        axes.legend(loc="lower right")
    figure.savefig(file, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    main()
