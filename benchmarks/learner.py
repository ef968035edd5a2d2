"""Updates per second of the learner and of its peers, alternating, in one table.

    python benchmarks/learner.py --peers /path/to/peers-venv/bin/python

Every contestant is a process of its own (`learner_workers.py`); they take turns in rounds of a few updates. The table
gives medians over the rounds: CPU time with one thread, wall time with more. The last column is what the update's
matrix products would need at the rate that large bfloat16 products reach here, as a share of the update.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path

from contest import Worker, measure
from learner_workers import MATMUL_FLOPS, PEERS, WORKERS, flops_per_update

OURS, YARDSTICK = "coachable-bf16", "matmul-bf16"


def table(seconds: dict[str, list[float]]) -> str:
    """Medians, rates, ratios to ours, and the share of the rate of large matrix products."""
    median = {name: statistics.median(t) for name, t in seconds.items()}
    rate = MATMUL_FLOPS / median[YARDSTICK] if YARDSTICK in median else None
    lines = ["| contestant | ms / update | updates / s | ours is faster by | of large bf16 products |", "|-|-|-|-|-|"]
    for name, time in median.items():
        if name.startswith("matmul"):
            lines.append(f"| {name} | {MATMUL_FLOPS / time / 1e9:.0f} GFLOP/s | | | |")
            continue
        ratio = f"{time / median[OURS]:.2f}" if OURS in median else ""
        share = f"{flops_per_update() / time / rate:.2f}" if rate else ""
        lines.append(f"| {name} | {1e3 * time:.1f} | {1 / time:.1f} | {ratio} | {share} |")
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
    python = {name: args.peers if name in PEERS else sys.executable for name in args.only}
    workers = [Worker("learner_workers.py", name, python[name], args.threads) for name in args.only]
    work = {name: 4 if name.startswith("matmul") else args.updates for name in args.only}
    clock = "cpu" if args.threads == 1 else "wall"
    times = measure(workers, args.rounds, work)
    seconds = {name: [spent[clock] for spent in rounds] for name, rounds in times.items()}
    print(f"{args.threads} thread(s), {clock} time, {args.rounds} rounds, medians\n")
    print(table(seconds))
    if args.json:
        args.json.write_text(json.dumps(seconds))


if __name__ == "__main__":
    main()
