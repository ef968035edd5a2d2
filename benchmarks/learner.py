"""Time of an update of the learner and of its peers, alternating, in one table.

    python benchmarks/learner.py --peers /path/to/peers-venv/bin/python
    LEARNER_WIDTH=256 python benchmarks/learner.py      networks of 3 x 256 instead of 3 x 512

Every contestant is a process of its own for each number of threads (`learner_workers.py`); they take turns in rounds of
a few updates. The table gives medians of the wall time over the rounds. Contestants with `resnet` in their names have
the networks of `coachable`: residual, with layer norm. The others have plain ReLU networks of the same widths, which is
less work. They multiply in bfloat16 where the processor does, else in float32. The gain of `matmul-bf16` or
`matmul-fp32`, large products of matrices, is what the processor gives a further thread.
"""

import argparse
import json
import statistics
import sys
from pathlib import Path

from contest import Worker, measure, processor
from learner_work import WIDTH, flops_per_update
from learner_workers import MATMUL_FLOPS, PEERS, WORKERS

from coachable.training.precision import supports_bf16

PRECISION = "bf16" if supports_bf16("cpu") else "fp32"
OURS, YARDSTICK = f"coachable-{PRECISION}", f"matmul-{PRECISION}"
DEFAULT = (
    OURS,
    f"single-file-resnet-{PRECISION}",
    f"single-file-{PRECISION}",
    "torchrl-resnet",
    "torchrl",
    "sb3",
    "sbx-8",
    YARDSTICK,
)


def table(seconds: dict[int, dict[str, list[float]]]) -> str:
    """Return medians, the gain of further threads, and how much faster ours is, for each number of threads.

    Args:
        seconds: By number of threads and contestant, the seconds of an update in each round.
    """
    median = {n: {name: statistics.median(times) for name, times in run.items()} for n, run in seconds.items()}
    few, *more = median
    columns = [f"ms with {n} thread{'s' * (n > 1)}" for n in median]
    columns += [f"gain of {n} threads" for n in more]
    columns += [f"ours is faster by, {n} thread{'s' * (n > 1)}" for n in median]
    lines = ["| contestant | " + " | ".join(columns) + " |", "|-" * (1 + len(columns)) + "|"]
    for name in median[few]:
        product = name.startswith("matmul")
        times = [run[name] for run in median.values()]
        cells = [f"{MATMUL_FLOPS / t / 1e9:.0f} GFLOP/s" if product else f"{1e3 * t:.1f}" for t in times]
        cells += [f"{times[0] / t:.2f}" for t in times[1:]]
        cells += ["" if product or OURS not in run else f"{run[name] / run[OURS]:.2f}" for run in median.values()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def share_of_products(seconds: dict[str, list[float]]) -> float:
    """Return the time of an update's matrix products, at the rate of large ones, over the time of the update."""
    update, product = (statistics.median(seconds[name]) for name in (OURS, YARDSTICK))
    return flops_per_update() / update / (MATMUL_FLOPS / product)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", default=sys.executable, help="interpreter with stable-baselines3 and sbx-rl")
    parser.add_argument("--only", nargs="*", choices=list(WORKERS), default=DEFAULT, metavar="NAME", help="contestants")
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--updates", type=int, default=8, help="per round and contestant, a multiple of 8")
    parser.add_argument("--json", type=Path, help="where to write the seconds of every round")
    args = parser.parse_args()
    python = {name: args.peers if name in PEERS else sys.executable for name in args.only}
    work = {name: 4 if name.startswith("matmul") else args.updates for name in args.only}
    seconds = {}
    for threads in args.threads:
        workers = [Worker("learner_workers.py", name, python[name], threads) for name in args.only]
        times = measure(workers, args.rounds, work)
        seconds[threads] = {name: [spent["wall"] for spent in rounds] for name, rounds in times.items()}
    print(f"{processor()}; SAC, batch 256, 3 x {WIDTH}, wall time, medians of {args.rounds} rounds\n")
    print(table(seconds))
    for threads, run in seconds.items():
        if {OURS, YARDSTICK} <= set(run):
            print(
                f"\nProducts at the rate of {YARDSTICK}, {threads} thread(s): {share_of_products(run):.2f} of an update"
            )
    if args.json:
        args.json.write_text(json.dumps(seconds))


if __name__ == "__main__":
    main()
