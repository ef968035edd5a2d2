"""One training of one learner on a task of the DeepMind Control Suite; `dmc.py` starts one process for each.

    python benchmarks/dmc_workers.py '{"contestant": "sb3-sac", "task": "walker-walk", "seed": 0, ...}'

Every peer needs only its own packages, so that peers may live in another virtual environment. All contestants get the
same `Task`, which repeats each action twice. Environment steps are counted before the repetition: one decision of the
policy is two environment steps, and an episode has 1000.
"""

import copy
import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np

REPEAT = 2
EPISODE = 1000  # environment steps of every task of the suite
EVALUATIONS = 2  # episodes of one evaluation
SETTINGS = {  # ours, the same on all tasks
    "num_envs": 64,
    "widths": (256, 256),
    "batch_size": 256,
    "utd_ratio": 0.125,  # updates per decision
    "n_steps": 3,
    "gamma": 0.99,
    "tau": 0.01,
    "lr": 1e-3,
    "alpha": 0.02,  # of the start, if it is learnt
    "learn_alpha": False,
    "target_entropy": -1.0,  # per action dimension
    "random_steps": 5_000,  # decisions
    "capacity": 1_000_000,
}


@cache
def load_suite(name: str):
    """Load a task of the suite; its model is compiled once per process, because that takes 0.1 s."""
    from dm_control import suite

    return suite.load(*name.split("-"))


class Task:
    """A task of the suite with flat float32 observations and repeated actions.

    Args:
        name: Domain and task, such as `walker-walk`.
        seed: Seed of the initial states.
    """

    def __init__(self, name: str, seed: int) -> None:
        loaded = load_suite(name)
        self.physics = loaded.physics.copy(share_model=True)
        self.task = copy.deepcopy(loaded.task)
        self.task._random = np.random.RandomState(seed)
        self.substeps = round(loaded.control_timestep() / self.physics.timestep())
        self.steps_left = 0
        self.action_dim = loaded.action_spec().shape[0]
        self.obs_dim = len(self.reset())

    def reset(self) -> np.ndarray:
        self.steps_left = EPISODE
        with self.physics.reset_context():
            self.task.initialize_episode(self.physics)
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """Apply an action twice; return observation, sum of rewards, terminated (physics diverged) and truncated.

        This is what two calls of `Environment.step` do, less the observation between them, which nobody sees.
        """
        from dm_control.rl.control import PhysicsError

        task, physics, reward = self.task, self.physics, 0.0
        try:
            for _ in range(REPEAT):
                task.before_step(action.astype(np.float64), physics)
                physics.step(self.substeps)
                task.after_step(physics)
                reward += float(task.get_reward(physics))
        except PhysicsError:
            return self.reset(), 0.0, True, False
        self.steps_left -= REPEAT
        return self._observe(), reward, False, self.steps_left <= 0

    def _observe(self) -> np.ndarray:
        observation = self.task.get_observation(self.physics)
        return np.concatenate([np.ravel(part) for part in observation.values()]).astype(np.float32)


class Record:
    """Clock of the training time, and evaluations at every minute of it.

    Args:
        path: File that gets one JSON line per evaluation; it is emptied.
        task: Name of the task.
        minutes: Training time.
        clock: `"wall"`, or `"cpu"` for the processor time of all threads, which another load disturbs less.
        seed: The training's seed; evaluations start from other states.
    """

    def __init__(self, path: Path, task: str, minutes: float, seed: int, clock: str) -> None:
        self.file = path.open("w", buffering=1)
        self.tasks = [Task(task, 10_000 + 100 * seed + i) for i in range(EVALUATIONS)]
        self.seconds = 60 * minutes
        self.every = min(60.0, self.seconds)
        self.next = self.every
        self.now = {"wall": time.perf_counter, "cpu": time.process_time}[clock]
        self.began = self.now()

    def check(self, act: Callable[[np.ndarray], np.ndarray], decisions: int, updates: int) -> bool:
        """Evaluate if a minute has passed; return whether the training time is over.

        Args:
            act: Maps observations (n, O) to the policy's deterministic actions (n, A).
            decisions: Number of decisions in training so far.
            updates: Number of updates so far.
        """
        spent = self.now() - self.began
        if spent < self.next:
            return False
        row = {"minutes": round(spent / 60, 3), "env_steps": REPEAT * decisions, "updates": updates}
        self.file.write(json.dumps({**row, "return": round(self._evaluate(act), 1)}) + "\n")
        self.began = self.now() - spent
        self.next += self.every
        return spent >= self.seconds

    def _evaluate(self, act: Callable[[np.ndarray], np.ndarray]) -> float:
        observations = np.stack([task.reset() for task in self.tasks])
        total, over = 0.0, False
        while not over:
            stepped = [task.step(action) for task, action in zip(self.tasks, act(observations), strict=True)]
            observations = np.stack([step[0] for step in stepped])
            total += sum(step[1] for step in stepped)
            over = stepped[0][3] or any(step[2] for step in stepped)
        return total / len(self.tasks)


# -- ours --------------------------------------------------------------------------------------------------------------


def suite_env(name: str, num_envs: int, seed: int, threads: int):
    """Return `num_envs` tasks as one TorchRL environment."""
    import torch
    from tensordict import TensorDict
    from torchrl.data import Binary, Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase

    class SuiteEnv(EnvBase):
        def __init__(self) -> None:
            super().__init__(device="cpu", batch_size=torch.Size((num_envs,)))
            self.tasks = [Task(name, 1000 * seed + i) for i in range(num_envs)]
            self.pool = ThreadPoolExecutor(threads) if threads > 1 else None
            one = self.tasks[0]
            self.observations = np.zeros((num_envs, one.obs_dim), np.float32)
            self.action_spec = Bounded(-1.0, 1.0, (num_envs, one.action_dim), dtype=torch.float32)
            self.observation_spec = Composite(
                {"observation": Unbounded((num_envs, one.obs_dim), dtype=torch.float32)}, shape=self.batch_size
            )
            self.reward_spec = Unbounded((num_envs, 1), dtype=torch.float32)
            flags = ("done", "terminated", "truncated")
            flag = {name: Binary(1, (num_envs, 1), dtype=torch.bool) for name in flags}
            self.done_spec = Composite(flag, shape=self.batch_size)

        def _set_seed(self, seed: int | None) -> None:
            """Do nothing, because every task has its seed."""

        def _reset(self, tensordict=None, **_):
            chosen = None if tensordict is None else tensordict.get("_reset", None)
            rows = range(num_envs) if chosen is None else np.flatnonzero(chosen.numpy())
            for row in rows:
                self.observations[row] = self.tasks[row].reset()
            return TensorDict(self._flags(torch.zeros(2, num_envs, dtype=torch.bool)), self.batch_size)

        def _step(self, tensordict):
            actions = tensordict["action"].numpy()
            run = map if self.pool is None else self.pool.map
            observations, rewards, *ends = zip(*run(Task.step, self.tasks, actions), strict=True)
            self.observations[:] = observations
            out = self._flags(torch.tensor(ends))
            out["reward"] = torch.tensor(rewards, dtype=torch.float32)[:, None]
            return TensorDict(out, self.batch_size)

        def _flags(self, ends):
            terminated, truncated = ends[..., None]
            flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
            return {"observation": torch.from_numpy(self.observations.copy()), **flags}

    return SuiteEnv()


def coachable(task: str, seed: int, record: Callable[[], Record], threads: int, device: str, **changed: object) -> None:
    """Train with the library's boxes, without style: space None, no relabelling, one table."""
    import torch
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type
    from torchrl.objectives import SACLoss

    from coachable.fast import accelerate
    from coachable.networks import make_critic, make_gaussian_actor
    from coachable.replay import EventTableBuffer
    from coachable.training.collection import make_collector
    from coachable.training.learner import Learner
    from coachable.training.rng import seed_everything

    cfg = SETTINGS | changed
    torch.set_num_threads(threads)
    seed_everything(seed)
    clock = record()
    env = suite_env(task, cfg["num_envs"], seed, threads)
    obs_dim, action_dim = env.tasks[0].obs_dim, env.tasks[0].action_dim
    actor = make_gaussian_actor(obs_dim, action_dim, None, cfg["widths"]).to(device)
    loss = SACLoss(
        actor,
        [make_critic(obs_dim, action_dim, None, cfg["widths"]).to(device) for _ in range(2)],
        loss_function="l2",
        alpha_init=cfg["alpha"],
        fixed_alpha=not cfg["learn_alpha"],
        target_entropy=cfg["target_entropy"] * action_dim,
        action_spec=env.action_spec,
    )
    loss.make_value_estimator(gamma=cfg["gamma"])
    learner = Learner(loss.to(device), actor_lr=cfg["lr"], critic_lr=cfg["lr"], alpha_lr=cfg["lr"], tau=cfg["tau"])
    accelerate(learner)
    replay = EventTableBuffer(
        {"default": cfg["capacity"]}, n_steps=cfg["n_steps"], gamma=cfg["gamma"], prioritized=False
    )
    collector = make_collector(
        lambda _: env,
        actor,
        frames_per_batch=cfg["num_envs"],
        init_random_frames=cfg["random_steps"],
        seed=seed,
        policy_device=device,
    )
    stored = ("observation", "action", ("collector", "traj_ids"))
    stored += tuple(("next", key) for key in ("observation", "reward", "done", "terminated"))

    def act(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            seen = TensorDict({"observation": torch.from_numpy(observations)}, observations.shape[:1])
            return actor(seen.to(device))["action"].cpu().numpy()

    decisions, owed = 0, 0.0
    for data in collector:
        decisions += data.numel()
        replay.extend(data.contiguous().select(*stored).reshape(-1))
        if decisions > cfg["random_steps"]:
            owed += data.numel() * cfg["utd_ratio"]
        with learner.backend.working():
            while owed >= 1.0:
                learner.update(replay.sample(cfg["batch_size"]).to(device))
                owed -= 1.0
        if clock.check(act, decisions, learner.updates):
            break
    collector.shutdown()


# -- peers -------------------------------------------------------------------------------------------------------------


def peer(
    library: str, algorithm: str, task: str, seed: int, record: Callable[[], Record], num_envs: int = 1, **options
) -> None:
    """Train with an algorithm of Stable-Baselines3, sb3-contrib or sbx, as a user would.

    Args:
        library: Name of the module.
        algorithm: Name of the class in it.
        task: Name of the task.
        seed: Seed of the training.
        record: Starts the clock.
        num_envs: Number of environments, stepped one after the other.
        **options: Of the algorithm.
    """
    from importlib import import_module

    import gymnasium as gym
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv

    class Env(gym.Env):
        def __init__(self, index: int) -> None:
            self.task = Task(task, 1000 * seed + index)
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, (self.task.obs_dim,), np.float32)
            self.action_space = gym.spaces.Box(-1.0, 1.0, (self.task.action_dim,), np.float32)

        def reset(self, *, seed=None, options=None):
            return self.task.reset(), {}

        def step(self, action):
            return *self.task.step(action), {}

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            model = self.model
            act = lambda observations: model.predict(observations, deterministic=True)[0]  # noqa: E731
            return not clock.check(act, self.num_timesteps, model._n_updates)

    kind = getattr(import_module(library), algorithm)
    clock = record()
    env = DummyVecEnv([lambda i=i: Env(i) for i in range(num_envs)])
    model = kind("MlpPolicy", env, seed=seed, **options)
    model.learn(10**9, callback=Clock())


def setup(library: str, algorithm: str, **options: object) -> Callable[..., None]:
    """Return a contestant that trains with these options, with the arguments of `coachable`."""
    return lambda task, seed, record, threads, device: peer(library, algorithm, task, seed, record, **options)


# One update per decision, learning rate 3e-4, batches of 256 and networks of 2 x 256 are the defaults of SAC and TQC in
# both libraries. The random decisions at the start are what the training zoo of Stable-Baselines3 adds for MuJoCo.
# CrossQ has its own defaults, critics of 2 x 1024 among them. The last contestant has our number of environments and
# updates per decision.
CONTESTANTS = {
    "coachable": coachable,
    "sb3-sac": setup("stable_baselines3", "SAC", learning_starts=10_000, device="cpu"),
    "sb3-tqc": setup("sb3_contrib", "TQC", learning_starts=10_000, device="cpu"),
    "sbx-sac": setup("sbx", "SAC", learning_starts=10_000),
    "sbx-crossq": setup("sbx", "CrossQ", learning_starts=5_000),
    "sbx-sac-64-envs": setup("sbx", "SAC", learning_starts=10_000, num_envs=64, gradient_steps=8),
}


def main(job: str) -> None:
    """Run the job that a JSON text describes, on the first `threads` cores of this process."""
    task = json.loads(job)
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: task["threads"]])
    warnings.simplefilter("ignore")
    path = Path(task["path"])
    train = CONTESTANTS[task["contestant"]]

    def record() -> Record:
        return Record(path, task["task"], task["minutes"], task["seed"], task["clock"])

    settings = task.get("settings", {})
    train(task["task"], task["seed"], record, task["threads"], task["device"], **settings)


if __name__ == "__main__":
    main(sys.argv[1])
