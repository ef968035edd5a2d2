"""Combat env steps per second for several batch sizes.

    python benchmarks/combat.py --envs 64 512 2048 8192 16384
    python benchmarks/combat.py --envs 2048 --side-by-side 2 --peers .venv-bench/bin/python

Every fight acts at random; finished fights are reset; observations, rewards, features, events and TensorDict included.
CPU time is given beside wall time, which other programs on the machine affect. `--side-by-side 2` steps 2048 fights in
each of two processes at once; `--peers` names an interpreter with vizdoom, which plays in turn with ours.
"""

import argparse
import json
import resource
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from combat_workers import DRAWN, FIGHTS, advance
from contest import Worker, measure

from coachable.envs.combat import CombatEnv


def bench(num_envs: int, steps: int, device: str) -> dict[str, float]:
    fights = CombatEnv(num_envs, seed=0, device=device)
    actions = fights.action_spec.rand((DRAWN,))
    current = advance(fights, fights.reset(), actions, 5)
    synchronize = torch.cuda.synchronize if device == "cuda" else lambda: None
    synchronize()
    wall, cpu = time.perf_counter(), time.process_time()
    advance(fights, current, actions, steps)
    synchronize()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    state = sum(t.nbytes for t in fights.state.tensors().values()) + sum(t.nbytes for t in vars(fights.traits).values())
    return {
        "envs": num_envs,
        "steps_per_second": num_envs * steps / wall,
        "steps_per_cpu_second": num_envs * steps / cpu,
        "ms_per_batch_step": 1e3 * wall / steps,
        "state_kilobytes_per_fight": state / num_envs / 1024,
    }


def side_by_side(processes: int, steps: int) -> float:
    """Return the steps per second (wall) of so many processes that run at once."""
    workers = [Worker("combat_workers.py", "coachable", sys.executable, threads=1) for _ in range(processes)]
    if not all([worker.ready() for worker in workers]):
        raise SystemExit("a process could not be set up")
    with ThreadPoolExecutor(processes) as pool:
        seconds = max(taken["wall"] for taken in pool.map(lambda worker: worker.run(steps), workers))
    for worker in workers:
        worker.close()
    return processes * FIGHTS * steps / seconds


def beside_doom(peers: str, steps: int) -> dict[str, float]:
    """Return the steps per second (wall) of one process of each, in turn, median of five rounds."""
    pythons = {"coachable": sys.executable, "vizdoom": peers}
    workers = [Worker("combat_workers.py", name, python, threads=1) for name, python in pythons.items()]
    times = measure(workers, 5, {"coachable": steps, "vizdoom": 20 * steps})
    rows = {"coachable": FIGHTS, "vizdoom": 1}
    return {name: rows[name] / statistics.median(t["wall"] for t in rounds) for name, rounds in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", type=int, nargs="+", default=[64, 512, 2048, 8192, 16384])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--side-by-side", type=int, default=0, metavar="PROCESSES", help="0 for none")
    parser.add_argument("--peers", help="interpreter with vizdoom")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows = []
    print("| envs | steps/s (wall) | steps per CPU second | ms per batch step | state KB per fight |\n|-|-|-|-|-|")
    for num_envs in args.envs:
        row = bench(num_envs, args.steps, args.device)
        rows.append(row)
        print("| {envs} | {steps_per_second:,.0f} | {steps_per_cpu_second:,.0f} |".format(**row), end="")
        print(" {ms_per_batch_step:.1f} | {state_kilobytes_per_fight:.1f} |".format(**row), flush=True)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    found: dict[str, Any] = {"rows": rows}
    if args.side_by_side:
        found["side_by_side"] = side_by_side(args.side_by_side, args.steps)
        print(f"{args.side_by_side} processes at once: {found['side_by_side']:,.0f} steps/s")
    if args.peers:
        found["beside_doom"] = beside_doom(args.peers, args.steps)
        for name, rate in found["beside_doom"].items():
            print(f"{name}, one process: {rate:,.0f} steps/s")
    if args.json:
        args.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
