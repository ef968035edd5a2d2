"""Rollout worker, which runs in or below a Ray actor: environments, a copy of the policy, and TorchRL's collector."""

import mmap
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cloudpickle
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType

from coachable.cluster.flat_weights import load_flat_weights
from coachable.code_version import RECIPES, code_version
from coachable.training.collection import follow_policy
from coachable.training.rng import seed_everything
from coachable.training.throttle import Throttle

MAX_WORKERS = 4096  # numbers of workers take 12 bits of a trajectory number, starts 19 and trajectories 32
_BURST = 1.0  # [s] that a throttled worker catches up after a pause


@dataclass(frozen=True)
class WorkerSettings:
    """Settings of one worker.

    Attributes:
        worker: Number of the worker.
        start: How often the worker had been started before, in the whole run.
        seed: Seed of the training; the worker's random numbers depend on it, `worker` and `start`.
        steps_per_batch: Number of steps of each environment in a batch.
        throttle: Highest rate [env-steps/s]; None for no limit.
        code: Version of the learner's code, which the worker has to have, too.
    """

    worker: int
    start: int
    seed: int
    steps_per_batch: int
    throttle: float | None
    code: str

    def stream(self) -> int:
        """Return the seed of this start of this worker."""
        return int(np.random.SeedSequence([self.seed, self.worker, self.start]).generate_state(1)[0]) % 2**31


@dataclass(frozen=True)
class Batch:
    """Transitions of one worker on their way to the learner.

    Attributes:
        serial: Number of batches that this start of the worker had collected before.
        version: Number of updates that the policy's weights had seen.
        shape: Numbers of environments and steps.
        entries: Arrays by key.
    """

    serial: int
    version: int
    shape: tuple[int, ...]
    entries: dict[tuple[str, ...], np.ndarray]


class _Paced(Transform):
    """Environment transform that waits at each step as the throttle requires."""

    def __init__(self, throttle: Throttle) -> None:
        super().__init__()
        self.throttle = throttle

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.throttle.wait()
        self.throttle.add(next_tensordict.numel())
        return next_tensordict


class RolloutWorker:
    """Worker that collects one batch per call.

    It does nothing before `start`, so that whatever fails there is reported as an ordinary error.
    """

    def start(self, task: bytes, settings: WorkerSettings) -> tuple[int, str]:
        """Make the environments and the collector.

        Args:
            task: `(make_env, policy)`, pickled.
            settings: Settings of this worker.

        Returns:
            The process and the host of the worker.

        Raises:
            ValueError: If the learner's Python or coachable is another one.
        """
        found = code_version()
        if found != settings.code:
            raise ValueError(f"{os.uname().nodename} has {found}, the learner has {settings.code}")
        torch.set_num_threads(1)
        if RECIPES not in sys.path:
            sys.path.append(RECIPES)  # `make_env` of a recipe refers to the modules beside it
        make_env, self.policy = cloudpickle.loads(task)
        seed_everything(settings.stream())
        env: EnvBase = make_env(settings.stream())
        if settings.throttle is not None:
            env = env if isinstance(env, TransformedEnv) else TransformedEnv(env)
            env.append_transform(_Paced(Throttle(settings.throttle, _BURST)))
        self.settings = settings
        options: dict[str, Any] = {  # typed too narrowly in TorchRL
            "frames_per_batch": env.numel() * settings.steps_per_batch,
            "total_frames": -1,
            "exploration_type": ExplorationType.RANDOM,
        }
        plain: dict[str, Any] = {"use_buffers": False, "trust_policy": True, "auto_register_policy_transforms": False}
        self.collector = Collector(env, self.policy, **options, **plain)
        follow_policy(self.collector)
        self.serial = 0
        self.version = -1
        self._batches: Iterator[TensorDictBase] = iter(self.collector)
        return os.getpid(), os.uname().nodename

    def load(self, version: int, file: int) -> None:
        """Load weights.

        Args:
            version: Number of updates that they have seen.
            file: Descriptor of a file that holds them as `flat_weights` returns them.
        """
        pages = mmap.mmap(file, 0, access=mmap.ACCESS_COPY)  # not copied, but torch wants memory that it may write to
        load_flat_weights(self.policy, torch.frombuffer(pages, dtype=torch.float32))
        self.version = version

    def collect(self, random: bool) -> Batch:
        """Collect a batch.

        Args:
            random: Whether to act with uniformly random actions.
        """
        self.collector.init_random_frames = sys.maxsize if random else 0
        data = next(self._batches).contiguous()
        number = self.settings.start * MAX_WORKERS + self.settings.worker
        key: Any = ("collector", "traj_ids")
        data[key] = data[key] + (number << 32)
        entries = {
            key if isinstance(key, tuple) else (key,): value.numpy()
            for key, value in data.items(True, leaves_only=True)
        }
        self.serial += 1
        return Batch(self.serial - 1, self.version, tuple(data.shape), entries)
