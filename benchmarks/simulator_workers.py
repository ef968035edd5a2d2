"""The contestants of `simulator.py`. A unit of work is one control step of 64 humanoids."""

import sys

from contest import serve

ROWS = 64
SUBSTEPS = 5
RESET_EVERY = 40  # control steps: everybody simulates the same mix of standing and falling


def raw_mujoco():
    """The floor: `mj_step` of one humanoid, no observation, nothing else."""
    import mujoco
    import numpy as np

    import coachable  # noqa: F401 - chooses the OpenGL backend before dm_control looks for one
    from coachable.envs.humanoid.model import load_spec

    model = load_spec().compile()
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)

    def run(n):
        for step in range(n * ROWS):
            if step % RESET_EVERY == 0:
                mujoco.mj_resetData(model, data)
                data.qpos[2] = 1.2855
            data.ctrl[:] = random.uniform(-1, 1, 21)
            mujoco.mj_step(model, data, SUBSTEPS)

    return run


def coachable_env_steps(threads):
    """Ours: observation, task reward, style features, style sampler, style reward, episode sums, TensorDict."""
    import torch

    from coachable.domains.humanoid import humanoid_style_reward, humanoid_style_space
    from coachable.envs.humanoid import HumanoidEnv
    from coachable.training.episodes import EpisodeSums
    from coachable.transforms import coachable_env

    torch.set_num_threads(1)
    space = humanoid_style_space()
    base = HumanoidEnv(ROWS, seed=0, num_threads=threads, episode_steps=RESET_EVERY)
    env = coachable_env(base, space, humanoid_style_reward(space), EpisodeSums(), seed=0)
    state = {"td": env.reset()}

    def run(n):
        td = state["td"]
        for _ in range(n):
            td.set("action", torch.rand(ROWS, 21) * 2 - 1)
            _, td = env.step_and_maybe_reset(td)
        state["td"] = td

    return run


def dm_control():
    """dm_control's own Python environment: its observations and reward."""
    import numpy as np
    from dm_control import suite

    import coachable  # noqa: F401

    env = suite.load("humanoid", "walk", task_kwargs={"random": 0})
    random = np.random.default_rng(0)

    def upright():
        env.reset()
        with env.physics.reset_context():
            env.physics.data.qpos[:] = env.physics.model.qpos0
            env.physics.data.qpos[2] = 1.2855

    def run(n):
        for step in range(n * ROWS):
            if step % RESET_EVERY == 0:
                upright()
            env.step(random.uniform(-1, 1, 21))

    return run


def torchrl_dm_control():
    """TorchRL's `DMControlEnv` with the transforms that its recipes put on it."""
    import torch
    from torchrl.envs import CatTensors, Compose, DMControlEnv, DoubleToFloat, StepCounter, TransformedEnv

    torch.set_num_threads(1)
    base = DMControlEnv("humanoid", "walk", random=0)
    names = ["joint_angles", "head_height", "extremities", "torso_vertical", "com_velocity", "velocity"]
    env = TransformedEnv(
        base,
        Compose(DoubleToFloat(), CatTensors(in_keys=names, out_key="observation"), StepCounter(max_steps=RESET_EVERY)),
    )
    state = {"td": env.reset()}

    def run(n):
        td = state["td"]
        for _ in range(n * ROWS):
            td.set("action", torch.rand(21, dtype=torch.float64) * 2 - 1)
            _, td = env.step_and_maybe_reset(td)
        state["td"] = td

    return run


def envpool():
    """envpool's C++ HumanoidWalk (its own MuJoCo), as many envs."""
    import envpool as pool
    import numpy as np

    env = pool.make_gymnasium("HumanoidWalk-v1", num_envs=ROWS, num_threads=1, seed=0)
    env.reset()
    random = np.random.default_rng(0)

    def run(n):
        for _ in range(n):
            env.step(random.uniform(-1, 1, (ROWS, 21)))

    return run


WORKERS = {
    "raw mj_step": raw_mujoco,
    "coachable, 1 thread": lambda: coachable_env_steps(1),
    "coachable, 2 threads": lambda: coachable_env_steps(2),
    "dm_control": dm_control,
    "torchrl DMControlEnv": torchrl_dm_control,
    "envpool": envpool,
}
PEERS = ("envpool",)


if __name__ == "__main__":
    serve(WORKERS, sys.argv[1], warmup=2)
