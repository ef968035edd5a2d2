"""Car-steps per second of the racing simulator, eager and compiled, as one table.

    OMP_NUM_THREADS=1 python benchmarks/racing.py --threads 1

A car-step is one control step of 0.1 s (10 substeps) of one car. "physics" is the car alone; "step" is `RacingEnv.step`
with projection, observation, task reward, style features and TensorDict; "race" the same with five cars and contact.
The rate counts CPU seconds of this process times the threads that it was given, best of k, so that other work on the
machine disturbs it little; the wall rate is given beside it.
"""

import argparse
import resource
import time

import torch

from coachable.envs.racing import RacingEnv
from coachable.envs.racing.parameters import Resources, load_car
from coachable.envs.racing.simulation import Simulation
from coachable.envs.racing.state import HEATS, INPUT_ROWS, ROW, SPINS, STATE_ROWS, CarInputs

KINDS = ("physics", "step", "race")


def physics(n, compile, device):
    simulation = Simulation(load_car("gt3"), Resources(1.0, 1.0), compile=compile, device=device)
    state = torch.zeros(STATE_ROWS, n, device=device)
    state[ROW["vx"]], state[SPINS], state[HEATS], state[ROW["fuel"]], state[ROW["gear"]] = 50.0, 150.0, 80.0, 30.0, 4.0
    inputs = torch.zeros(INPUT_ROWS, n, device=device)
    rows = {name: row for row, name in enumerate(CarInputs._fields)}
    for name in ("drag_factor", "front_lift_factor", "grip_factor", "wear_factor", "node_tx"):
        inputs[rows[name]] = 1.0
    for name in ("left", "right", "margin"):
        inputs[rows[name]] = 1e6
    inputs[rows["throttle"]] = torch.rand(n, device=device)
    inputs[rows["steer_step"]] = 0.01 * torch.rand(n, device=device)
    return lambda: simulation.step(state, inputs)


def stepping(n, compile, device, cars):
    env = RacingEnv(n - n % cars, cars=cars, compiled=compile, device=device, seed=0, resources=Resources(9.0, 3.0))
    current = env.reset()
    current["action"] = torch.rand(env.num_envs, 2, device=device) * 2 - 1
    return lambda: env.step(current)


def measure(run, n, device, rounds):
    synchronise = torch.cuda.synchronize if device == "cuda" else lambda: None
    start = time.perf_counter()
    run()
    synchronise()
    first = time.perf_counter() - start
    cpu, wall = [], []
    for _ in range(rounds):
        begin = time.perf_counter(), time.process_time()
        run()
        synchronise()
        wall.append(time.perf_counter() - begin[0])
        cpu.append(time.process_time() - begin[1])
    return first, n / min(cpu), n / min(wall)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--sizes", type=int, nargs="*", default=[256, 1024, 4096, 16384, 65536])
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--modes", nargs="*", choices=("eager", "compiled"), default=["eager", "compiled"])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    print(f"threads {args.threads}, device {args.device}, 10 substeps, best of {args.rounds}")
    print("| what | mode | cars | first call s | car-steps / CPU s | car-steps / s (wall) |\n|-|-|-|-|-|-|")
    for kind in args.kinds:
        for mode in args.modes:
            for n in args.sizes:
                make = {"physics": physics, "step": stepping, "race": stepping}[kind]
                options = {} if kind == "physics" else {"cars": 5 if kind == "race" else 1}
                run = make(n, mode == "compiled", args.device, **options)
                first, cpu, wall = measure(run, n, args.device, args.rounds)
                cpu *= args.threads
                print(f"| {kind} | {mode} | {n} | {first:.1f} | {cpu:,.0f} | {wall:,.0f} |", flush=True)
                torch.compiler.reset()
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")


if __name__ == "__main__":
    main()
