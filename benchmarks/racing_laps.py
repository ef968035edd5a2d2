"""Flying laps, one per row of cars: times, fuel, tyre wear and lapses, of the scripted driver or of a trained agent.

    OMP_NUM_THREADS=1 python benchmarks/racing_laps.py gt3 x2019            the scripted driver in these cars
    OMP_NUM_THREADS=1 python benchmarks/racing_laps.py runs/RUN             a resources agent, over its weights

Cars start alone at three places of Lakeside at a sensible speed, with new medium tyres of 80 °C and half a tank; a lap
ends where it began. Agents act deterministically. Wear and fuel run at the calibrated rates.
"""

import argparse
from pathlib import Path

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coachable.domain import load_domain
from coachable.envs.racing import RacingEnv
from coachable.envs.racing.driver import LineFollower
from coachable.envs.racing.line import minimum_curvature_line
from coachable.envs.racing.parameters import CARS, Resources
from coachable.envs.racing.referee import TELEMETRY
from coachable.envs.racing.scenarios import Conditions, Scenario
from coachable.envs.racing.state import ROW, WEARS
from coachable.keys import STYLE
from coachable.training.weights import load_policy

STARTS = 3
LINE_MARGIN, GRIP = 2.0, 0.93
SETTINGS = {
    "seed": 0,
    "scenarios": (Scenario("solo", 1.0, "solo"),),
    "conditions": Conditions(fuel=50.0),
    "episode_steps": 10**6,
}


def drive(env, act, steps):
    """Of each car: lap time (inf if unfinished), fuel, wear, steps off course, distance covered."""
    current = env.reset()
    length, n = env.course.length, env.num_envs
    fuel, wear = env.state[ROW["fuel"]].clone(), env.state[WEARS].mean(0).clone()
    result = {name: torch.full((n,), torch.inf) for name in ("time", "fuel", "wear")}
    off, ended, covered = torch.zeros(n), torch.zeros(n, dtype=torch.bool), torch.zeros(n)
    for step in range(1, steps + 1):
        current = env.step(current.set("action", act(current)))["next"]
        told = {name: current["telemetry"][:, TELEMETRY.index(name)] for name in ("distance", "progress", "off")}
        running = result["time"].isinf() & ~ended
        off += running * told["off"]
        covered = torch.where(running, told["distance"], covered)
        home = running & (told["distance"] >= length)
        late = (told["distance"] - length) / told["progress"].clamp(min=1e-6)
        result["time"] = torch.where(home, 0.1 * (step - late), result["time"])
        result["fuel"] = torch.where(home, fuel - env.state[ROW["fuel"]], result["fuel"])
        result["wear"] = torch.where(home, env.state[WEARS].mean(0) - wear, result["wear"])
        ended |= current["terminated"].flatten()
        if not (result["time"].isinf() & ~ended).any():
            break
    return result | {"off": off, "covered": covered}


def show(label, result):
    done = ~result["time"].isinf()
    mean = [f"{result[name][done].mean():{form}}" for name, form in (("time", ".1f"), ("fuel", ".2f"), ("wear", ".4f"))]
    off, covered = result["off"].mean() / 10, result["covered"].mean()
    print(f"| {label} | {int(done.sum())}/{len(done)} | {' | '.join(mean)} | {off:.1f} | {covered:.0f} |", flush=True)


def scripted(car, steps):
    env = RacingEnv(STARTS, car=car, resources=Resources.calibrated(car), **SETTINGS)
    line = minimum_curvature_line(env.track, margin=LINE_MARGIN)
    driver = LineFollower(env.track, env.garage.typical, grip=GRIP, line=line)
    show(f"scripted, {car}", drive(env, lambda current: driver(env, current["observation"]), steps))


def trained(source, steps):
    agent = load_policy(source)
    domain = load_domain(agent.metadata["domain"], agent.config)
    cells = domain.cells()
    env = domain.make_env(num_envs=STARTS * len(cells), **SETTINGS)
    theta = torch.stack([agent.space.make(**cell) for cell in cells]).repeat_interleave(STARTS, 0)
    # Every style from the same places.
    env.seeds = env.seeds[:STARTS].repeat(len(cells))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        result = drive(env, lambda current: agent.actor(current.set(STYLE, theta))["action"], steps)
    for i, cell in enumerate(cells):
        label = ", ".join(f"{name} {value:g}" for name, value in cell.items())
        show(label, {name: values[i * STARTS : (i + 1) * STARTS] for name, values in result.items()})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", nargs="+", help=f"a car ({', '.join(CARS)}), or an agent")
    parser.add_argument("--steps", type=int, default=2000, help="at most, of 0.1 s (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print("| driver | laps | time s | fuel l | wear | off s | covered m |\n|-|-|-|-|-|-|-|")
    for source in args.sources:
        scripted(source, args.steps) if source in CARS else trained(Path(source), args.steps)


if __name__ == "__main__":
    main()
