"""The contestants of benchmarks/racing.py, each in a process of its own: `python racing_workers.py NAME`."""

import os
import sys
from collections.abc import Callable
from typing import Any

from contest import serve

CARS = 4096  # 4095 in races of five
POOLED = 64  # environments of EnvPool
THREADS = int(os.environ.get("OMP_NUM_THREADS", "1"))


def physics(num_cars: int, compiled: bool, device: str) -> Callable[[], Any]:
    """The cars alone, from the same state over and over: neither track nor task."""
    import torch

    from coachable.envs.racing.physics.cars import Resources, load_car
    from coachable.envs.racing.physics.simulation import Simulation
    from coachable.envs.racing.physics.state import HEATS, INPUT_ROWS, ROW, SPINS, STATE_ROWS, CarInputs

    simulation = Simulation(load_car("gt3"), Resources(1.0, 1.0), compile=compiled, device=device)
    state = torch.zeros(STATE_ROWS, num_cars, device=device)
    state[ROW["vx"]], state[SPINS], state[HEATS], state[ROW["fuel"]], state[ROW["gear"]] = 50.0, 150.0, 80.0, 30.0, 4.0
    inputs = torch.zeros(INPUT_ROWS, num_cars, device=device)
    rows = {name: row for row, name in enumerate(CarInputs._fields)}
    for name in ("drag_factor", "front_lift_factor", "grip_factor", "wear_factor", "node_tx"):
        inputs[rows[name]] = 1.0
    for name in ("left", "right", "margin"):
        inputs[rows[name]] = 1e6
    inputs[rows["throttle"]] = torch.rand(num_cars, device=device)
    inputs[rows["steer_step"]] = 0.01 * torch.rand(num_cars, device=device)
    return lambda: simulation.step(state, inputs)


def make_env(num_cars: int, compiled: bool, device: str, cars: int) -> Any:
    """Races of `cars` cars, at most `num_cars` in all; wear and fuel as in the trainings."""
    from coachable.envs.racing import RacingEnv
    from coachable.envs.racing.physics.cars import Resources

    resources = Resources(9.0, 3.0)
    return RacingEnv(
        num_cars - num_cars % cars, cars=cars, compiled=compiled, device=device, seed=0, resources=resources
    )


def stepping(num_cars: int, compiled: bool, device: str, cars: int = 1) -> Callable[[], Any]:
    """`RacingEnv.step`, one random action per car throughout, without resets."""
    import torch

    env = make_env(num_cars, compiled, device, cars)
    current = env.reset()
    current["action"] = torch.rand(env.num_envs, 2, device=device) * 2 - 1
    return lambda: env.step(current)


def policy(num_cars: int, compiled: bool, device: str) -> Callable[[], Any]:
    """The same with actions sampled by a policy of 3 x 256 (residual, layer norm), from what it sees."""
    import torch
    from torchrl.envs.utils import step_mdp

    from coachable.networks import make_gaussian_actor

    env = make_env(num_cars, compiled, device, 1)
    actor = make_gaussian_actor(env.observation_size, 2, None, [256, 256, 256]).to(device)
    if compiled:
        actor.module[0].module.compile(dynamic=False)
    current = env.reset()

    def run() -> None:
        nonlocal current
        with torch.no_grad():
            current = step_mdp(env.step(actor(current)))

    return run


KINDS: dict[str, Callable[..., Callable[[], Any]]] = {
    "physics": physics,
    "step": stepping,
    "race": lambda *where: stepping(*where, cars=5),
    "policy": policy,
}


def repeated(kind: str) -> Callable[[], Callable[[int], None]]:
    """A contestant of ours, compiled; a unit of work is one control step of all cars."""

    def set_up() -> Callable[[int], None]:
        import torch

        torch.set_num_threads(THREADS)
        torch.manual_seed(0)
        step = KINDS[kind](CARS, True, "cpu")

        def run(steps: int) -> None:
            for _ in range(steps):
                step()

        return run

    return set_up


def gymnasium(name: str) -> Callable[[], Callable[[int], None]]:
    """A peer: one environment, random actions, without resets like ours; a unit of work is one step of it."""

    def set_up() -> Callable[[int], None]:
        import gymnasium as gym

        if name.startswith("racetrack"):
            import highway_env

            gym.register_envs(highway_env)
        env = gym.make(name, disable_env_checker=True)
        env.action_space.seed(0)
        env.reset(seed=0)

        def run(steps: int) -> None:
            for _ in range(steps):
                env.step(env.action_space.sample())

        return run

    return set_up


def envpool(name: str) -> Callable[[], Callable[[int], None]]:
    """A peer in C++: many environments, random actions; a unit of work is one step of all. Ended ones start again."""

    def set_up() -> Callable[[int], None]:
        import envpool
        import numpy as np

        env = envpool.make_gymnasium(name, num_envs=POOLED, num_threads=THREADS, seed=0)
        env.reset()
        random, actions = np.random.default_rng(0), env.action_space
        discrete = hasattr(actions, "n")

        def run(steps: int) -> None:
            for _ in range(steps):
                if discrete:
                    action = random.integers(0, actions.n, POOLED)
                else:
                    action = random.uniform(actions.low, actions.high, (POOLED, *actions.shape)).astype("float32")
                env.step(action)

        return run

    return set_up


OURS = tuple(KINDS)
PEERS = {"highway-env": "racetrack-v0", "car-racing": "CarRacing-v3"}
POOLS = {"envpool racetrack": "Racetrack-v0", "envpool highway": "Highway-v0", "envpool car-racing": "CarRacing-v3"}
WORKERS = {kind: repeated(kind) for kind in KINDS} | {peer: gymnasium(name) for peer, name in PEERS.items()}
WORKERS |= {peer: envpool(name) for peer, name in POOLS.items()}

if __name__ == "__main__":
    serve(WORKERS, sys.argv[1], warmup=3)
