"""Car-steps per second of the racing simulator, eager and compiled, as one table.

    OMP_NUM_THREADS=1 python benchmarks/racing.py --threads 1 --peers .venv-bench/bin/python

A car-step is one control step of 0.1 s (10 substeps) of one car. "physics" is the car alone; "step" is `RacingEnv.step`
with projection, observation, task reward, style features and TensorDict; "race" the same with five cars and contact;
"policy" is "step" with actions sampled by a network of 3 x 256. The rate counts CPU seconds of this process times the
threads that it was given, best of k, so that other work on the machine disturbs it little; the wall rate is given
beside it. `--peers` names an interpreter with highway-env, gymnasium[box2d] and envpool, whose environments then step
in turn with ours, each in a process of its own with so many threads. The environments of highway-env and Gymnasium
step one at a time, in Python; those of EnvPool are in C++ and step together.
"""

import argparse
import json
import resource
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import torch
from contest import Worker, measure, processor
from racing_workers import CARS, KINDS, OURS, PEERS, POOLED, POOLS, make_env

MODES = ("eager", "compiled")


def cpu_seconds() -> float:
    """Of this process and the compilers that it started."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def bench(kind: str, num_cars: int, compiled: bool, device: str, rounds: int) -> dict[str, float]:
    """First call [s], and car-steps per CPU second and per second, best of so many rounds."""
    synchronize = torch.cuda.synchronize if device == "cuda" else lambda: None
    step = KINDS[kind](num_cars, compiled, device)
    wall, cpu = time.perf_counter(), cpu_seconds()
    step()
    synchronize()
    row = {"first_wall": time.perf_counter() - wall, "first_cpu": cpu_seconds() - cpu}
    for _ in range(2):
        step()
    walls, cpus = [], []
    for _ in range(rounds):
        synchronize()
        wall, cpu = time.perf_counter(), time.process_time()
        step()
        synchronize()
        cpus.append(time.process_time() - cpu)
        walls.append(time.perf_counter() - wall)
    stepped = num_cars - num_cars % 5 if kind == "race" else num_cars
    torch.compiler.reset()
    return row | {"per_cpu": stepped / min(cpus), "per_wall": stepped / min(walls)}


def memory(cars: int) -> dict[str, float]:
    """Return the bytes per car, beyond the observation: kept between steps, and written by a step for the learner."""
    env = make_env(1000, False, "cpu", cars)
    kept = [t for name, t in env.simulator_state().items() if name != "observation_now" and isinstance(t, torch.Tensor)]
    written = [t for name, t in env.rand_step(env.reset())["next"].items() if name != "observation"]
    return {name: sum(t.nbytes for t in some) / env.num_envs for name, some in (("kept", kept), ("written", written))}


def beside_peers(peers: str, rounds: int, seconds: float, threads: int) -> dict[str, dict[str, float]]:
    """Return the steps per CPU second and per second of one process of each, in turn, median of the rounds.

    Each works about so many seconds per round.
    """
    pythons = dict.fromkeys(OURS, sys.executable) | dict.fromkeys((*PEERS, *POOLS), peers)
    workers = [Worker("racing_workers.py", name, python, threads) for name, python in pythons.items()]
    work = {name: round((50 if name in (*OURS, *POOLS) else 100) * seconds) for name in pythons}
    times = measure(workers, rounds, work)
    units = dict.fromkeys(OURS, CARS) | dict.fromkeys(PEERS, 1) | dict.fromkeys(POOLS, POOLED)
    units["race"] = CARS - CARS % 5
    return {
        name: {clock: units[name] / statistics.median(t[clock] for t in taken) for clock in ("cpu", "wall")}
        for name, taken in times.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--cars", type=int, nargs="*", default=[256, 1024, 4096, 16384, 65536])
    parser.add_argument("--kinds", nargs="*", choices=OURS, default=OURS)
    parser.add_argument("--modes", nargs="*", choices=MODES, default=MODES)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--peers", help="interpreter with highway-env, gymnasium[box2d] and envpool")
    parser.add_argument("--json", type=Path, help="where to write the numbers")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    found: dict[str, Any] = {"threads": args.threads, "rounds": args.rounds, "rows": []}
    print(f"threads {args.threads}, device {args.device}, 10 substeps, best of {args.rounds}")
    print("| what | mode | cars | first call, CPU s (wall) | car-steps / CPU s | car-steps / s (wall) |\n|-|-|-|-|-|-|")
    for num_cars in args.cars:
        for kind in args.kinds:
            for mode in args.modes:
                row = bench(kind, num_cars, mode == "compiled", args.device, args.rounds)
                row["per_cpu"] *= args.threads
                found["rows"].append({"kind": kind, "mode": mode, "cars": num_cars} | row)
                print(f"| {kind} | {mode} | {num_cars} | {row['first_cpu']:.1f} ({row['first_wall']:.1f})", end="")
                print(f" | {row['per_cpu']:,.0f} | {row['per_wall']:,.0f} |", flush=True)
    for name, cars in (("single cars", 1), ("races of five", 5)):
        found[name] = memory(cars)
        print("bytes per car, {}: {kept:.0f} kept, {written:.0f} written".format(name, **found[name]))
    if args.peers:
        rates = found["beside"] = beside_peers(args.peers, 5, 1.0, args.threads)
        print(f"in turn, {args.threads} threads, {processor()}")
        print("| | steps / CPU s | steps / s (wall) | times highway-env, times envpool racetrack (wall) |\n|-|-|-|-|")
        rivals = [rates[peer]["wall"] for peer in ("highway-env", "envpool racetrack") if peer in rates]
        for name, rate in rates.items():
            over = [rate["wall"] / rival for rival in rivals]
            ratios = ", ".join(f"{ratio:,.2f}" for ratio in over)
            print(f"| {name} | {rate['cpu']:,.0f} | {rate['wall']:,.0f} | {ratios} |")
    if args.json:
        args.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
