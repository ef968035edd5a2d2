"""Updates per second of the learner and of its peers, alternating, on one table.

    python benchmarks/learner.py --peers /path/to/peers-venv/bin/python

Every contestant is a process of its own (`learner_workers.py`); they take turns in rounds of a few updates, so that
whatever else the machine does strikes all of them alike. The table gives medians over the rounds. With one thread, times
are CPU times; with more, wall times.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from learner_workers import PEERS, WORKERS, flops_per_update

HERE = Path(__file__).resolve().parent
MATMUL_FLOPS = 2 * 1024**3


class Worker:
    """A contestant's process."""

    def __init__(self, name: str, python: str, threads: int) -> None:
        self.name = name
        xla = "" if threads > 1 else "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        env = os.environ | {
            "OMP_NUM_THREADS": str(threads),
            "MKL_NUM_THREADS": str(threads),
            "XLA_FLAGS": xla,
            "JAX_PLATFORMS": "cpu",
            "PYTHONPATH": str(HERE.parent),
        }
        self.process = subprocess.Popen(
            [python, str(HERE / "learner_workers.py"), name],
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def ready(self) -> bool:
        line = self._line()
        if line.strip() != "ready":
            error = self.process.stderr.read().strip().splitlines()[-1:] if self.process.stderr else []
            sys.stderr.write(f"{self.name} is left out: {' '.join(error)}\n")
            return False
        return True

    def run(self, updates: int) -> dict[str, float]:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{updates}\n")
        self.process.stdin.flush()
        return json.loads(self._line())

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(10)

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline()


def measure(
    names: list[str], python: dict[str, str], threads: int, rounds: int, updates: int
) -> dict[str, list[float]]:
    """Seconds per update of each contestant, one figure per round."""
    workers = []
    for name in names:
        worker = Worker(name, python[name], threads)
        if worker.ready():
            workers.append(worker)
    clock = "cpu" if threads == 1 else "wall"
    times: dict[str, list[float]] = {w.name: [] for w in workers}
    for _ in range(rounds):
        for worker in workers:
            n = 4 if worker.name.startswith("matmul") else updates
            times[worker.name].append(worker.run(n)[clock] / n)
    for worker in workers:
        worker.close()
    return times


def table(times: dict[str, list[float]]) -> str:
    """Medians, rates, ratios to ours, and the share of the rate of large matrix products."""
    median = {name: statistics.median(t) for name, t in times.items()}
    ours = median.get("coachable-bf16")
    lines = ["| contestant | ms / update | updates / s | ours is faster by | of large bf16 products |", "|-|-|-|-|-|"]
    rate = MATMUL_FLOPS / median["matmul-bf16"] if "matmul-bf16" in median else None
    for name, seconds in median.items():
        if name.startswith("matmul"):
            lines.append(f"| {name} | {MATMUL_FLOPS / seconds / 1e9:.0f} GFLOP/s | | | |")
            continue
        ratio = f"{seconds / ours:.2f}" if ours else ""
        share = f"{flops_per_update() / seconds / rate:.2f}" if rate else ""
        lines.append(f"| {name} | {1e3 * seconds:.1f} | {1 / seconds:.1f} | {ratio} | {share} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", default=sys.executable, help="interpreter with stable-baselines3 and sbx-rl")
    parser.add_argument("--only", nargs="*", choices=list(WORKERS), default=list(WORKERS))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--updates", type=int, default=8, help="per round and contestant, a multiple of 8")
    parser.add_argument("--json", type=Path, help="where to write the seconds of every round")
    args = parser.parse_args()
    python = {name: args.peers if name in PEERS else sys.executable for name in WORKERS}
    times = measure(args.only, python, args.threads, args.rounds, args.updates)
    print(f"{args.threads} thread(s), {'CPU' if args.threads == 1 else 'wall'} time, {args.rounds} rounds, medians\n")
    print(table(times))
    if args.json:
        args.json.write_text(json.dumps(times))


if __name__ == "__main__":
    main()
