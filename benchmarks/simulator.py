"""Humanoid control steps per second beside the peers', in turn, as one table.

    python benchmarks/simulator.py --peers .venv-bench/bin/python

A control step is five physics steps of 5 ms. Ours includes observations, task reward, style features, style sampler,
style reward, episode sums and TensorDict; the peers include their own observations and rewards. All contestants
start upright and act at random for 40 steps, except `torchrl DMControlEnv` and `envpool`, which can start only from the
suite's random states.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path

from contest import Worker, measure
from simulator_workers import PEERS, ROWS, WORKERS


def table(times: dict[str, list[dict[str, float]]]) -> str:
    """Medians: CPU microseconds and wall rate per control step of one humanoid, and ratios of CPU time to ours."""
    cpu = {name: statistics.median(t["cpu"] for t in rounds) / ROWS for name, rounds in times.items()}
    wall = {name: statistics.median(t["wall"] for t in rounds) / ROWS for name, rounds in times.items()}
    ours = cpu["coachable, 1 thread"]
    lines = ["| contestant | CPU us / step | steps / s (wall) | CPU time over ours |", "|-|-|-|-|"]
    for name, seconds in cpu.items():
        lines.append(f"| {name} | {1e6 * seconds:.0f} | {1 / wall[name]:,.0f} | {seconds / ours:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", default=sys.executable, help="interpreter with envpool")
    parser.add_argument("--only", nargs="*", choices=list(WORKERS), default=list(WORKERS))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--steps", type=int, default=10, help=f"control steps of {ROWS} humanoids per round")
    parser.add_argument("--json", type=Path, help="where to write the seconds of every round")
    args = parser.parse_args()
    python = {name: args.peers if name in PEERS else sys.executable for name in WORKERS}
    workers = [Worker("simulator_workers.py", name, python[name], threads=1) for name in args.only]
    times = measure(workers, args.rounds, args.steps)
    print(table(times))
    if args.json:
        args.json.write_text(json.dumps(times))


if __name__ == "__main__":
    main()
