"""`GymnasiumEnv`: a TorchRL environment of several copies of a Gymnasium environment."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from coachable.distributions.action_heads import ActionHeads
from coachable.finite import require_action
from coachable.gym.actions import action_components, native_action
from coachable.gym.checked_features import Features, checked_features, flat_observation
from coachable.keys import STYLE_FEATURES, TASK_REWARD
from coachable.object_state import load_object, save_object
from coachable.specs import set_specs


class GymnasiumEnv(EnvBase):
    """TorchRL environment `[N]` of N copies of a Gymnasium environment, for `coachable_env`.

    Observations are flattened to float32. Actions are those of `ActionHeads`: a `Box` is scaled to [-1, 1] per entry,
    `Discrete`, `MultiDiscrete` and `MultiBinary` have a one-hot vector per component, and the parts of `Tuple` and
    `Dict` spaces are concatenated. The copies are stepped one after the other; use `collector=process` for several
    processes.

    Args:
        make: Name of a registered environment, or a function that makes a new one at each call.
        features: Function that computes `style_features`, see `Features`.
        num_envs: Number of copies N.
        seed: Seed of the first resets.

    Keys written: `observation` (N, obs_dim), `task_reward` (N, 1), the environment's reward, `style_features` (N, F),
    `done`, `terminated`, `truncated` (N, 1).

    Raises:
        ValueError: If the action space has a component of another kind, or a `Box` without finite bounds, or `make`
            returns the same environment twice or a vectorised one. At a step or reset, if the number of features
            changes, or an observation does not have the size of its space.

    Example:
        >>> env = GymnasiumEnv("Pendulum-v1", lambda obs, action, info: obs[2:], num_envs=2, seed=0)
        >>> env.rollout(3)["next", "style_features"].shape
        torch.Size([2, 3, 1])
    """

    def __init__(
        self, make: str | Callable[[], gymnasium.Env], features: Features, num_envs: int = 1, *, seed: int | None = None
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        if not isinstance(make, str) and not callable(make):
            raise ValueError(
                f"make is {make}: expected the name of a registered environment, or a function that makes one"
            )
        super().__init__(device="cpu", batch_size=torch.Size((num_envs,)))
        self.features = features
        self.envs = [gymnasium.make(make) if isinstance(make, str) else make() for _ in range(num_envs)]
        for env in self.envs:
            if not hasattr(env, "action_space"):
                raise ValueError(f"make returned {env}: expected an environment of Gymnasium")
        _require_separate(self.envs)
        first = self.envs[0]
        sizes, axes = action_components(first.action_space)
        self.heads = ActionHeads(tuple(sizes), axes)
        self._observation = np.zeros((num_envs, spaces.flatdim(first.observation_space)), dtype=np.float32)
        self._finished = np.zeros(num_envs, dtype=bool)
        first.reset(seed=seed)  # wrappers may remember this episode, for instance in running means
        first.action_space.seed(seed)
        trial = first.action_space.sample()
        observation, *_, info = _stepped(first, trial)
        self._num_features = len(checked_features(features(observation, trial, info)))
        width = self._observation.shape[1]
        action = self.heads.spec(self.batch_size)
        set_specs(self, action=action, observation=width, style_features=self._num_features)
        self._set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        """Derive the seeds that the environments get at their next reset."""
        self._seeds: list[int | None] = [None] * len(self.envs)
        if seed is not None:
            self._seeds[:] = np.random.SeedSequence(seed).generate_state(len(self.envs)).tolist()

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        partial = None if tensordict is None else tensordict.get("_reset", None)
        mask = np.ones(len(self.envs), dtype=bool) if partial is None else partial.reshape(-1).numpy()
        for row in np.flatnonzero(mask).tolist():
            self._start(row)
        none = np.zeros(len(self.envs), dtype=bool)
        out = self._package(np.zeros(len(self.envs)), np.zeros((len(self.envs), self._num_features)), none, none)
        return out.exclude("reward")

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get("action").detach()
        require_action(actions, len(self.envs), self.heads.action_dim)
        choices = self.heads.choices(actions).tolist() if self.heads.categorical else [[]] * len(self.envs)
        axes = self.heads.split(actions)[1].clamp(-1.0, 1.0).tolist()
        rewards = np.zeros(len(self.envs))
        terminated, truncated = np.zeros((2, len(self.envs)), dtype=bool)
        features = np.zeros((len(self.envs), self._num_features))
        for row, env in enumerate(self.envs):
            if self._finished[row]:  # evaluations step finished episodes on without a reset
                self._start(row)
            action = native_action(env.action_space, iter(choices[row]), iter(axes[row]))
            observation, rewards[row], terminated[row], truncated[row], info = _stepped(env, action)
            found = checked_features(self.features(observation, action, info))
            if len(found) != self._num_features:  # NumPy would repeat a single number
                raise ValueError(f"features returned {len(found)} numbers: expected {self._num_features}, as at first")
            features[row] = found
            self._observe(row, observation)
        self._finished = terminated | truncated
        return self._package(rewards, features, terminated, truncated)

    def _start(self, row: int) -> None:
        env = self.envs[row]
        observation, _ = env.reset(seed=self._seeds[row])
        self._seeds[row] = None
        self._finished[row] = False
        self._observe(row, observation)

    def _observe(self, row: int, observation: Any) -> None:
        flat, width = flat_observation(self.envs[row].observation_space, observation), self._observation.shape[1]
        if flat.shape != (width,):  # NumPy would repeat a single number
            raise ValueError(f"an observation has {flat.size} numbers: expected {width}, as its space has")
        self._observation[row] = flat

    def _package(
        self, rewards: np.ndarray, features: np.ndarray, terminated: np.ndarray, truncated: np.ndarray
    ) -> TensorDictBase:
        flags = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        reward = torch.from_numpy(rewards)[:, None].float()
        return TensorDict(
            {
                "observation": torch.from_numpy(self._observation.copy()),
                TASK_REWARD: reward,
                "reward": reward.clone(),
                STYLE_FEATURES: torch.from_numpy(features).float(),
                **{name: torch.from_numpy(flag.copy())[:, None] for name, flag in flags.items()},
            },
            batch_size=self.batch_size,
        )

    def simulator_state(self) -> dict[str, Any]:
        """Return the attributes of all environments and their wrappers, for exact resumption.

        Raises:
            UnsavableError: If an attribute cannot be saved; the message names it.
        """
        return {
            "environments": [save_object(env) for env in self.envs],
            "observation": torch.from_numpy(self._observation.copy()),
            "finished": torch.from_numpy(self._finished.copy()),
            "seeds": list(self._seeds),
        }

    def load_simulator_state(self, state: dict[str, Any]) -> None:
        """Restore the output of `simulator_state`.

        Raises:
            UnsavableError: If it does not fit the environments.
        """
        for env, saved in zip(self.envs, state["environments"], strict=True):
            load_object(env, saved)
        self._observation = state["observation"].numpy().copy()
        self._finished = state["finished"].numpy().copy()
        self._seeds = list(state["seeds"])

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments."""
        if not self.is_closed:
            for env in self.envs:
                env.close()
        super().close(raise_if_closed=raise_if_closed)


def _stepped(env: Any, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Make a step, and check that its reward and flags are single numbers."""
    result = env.step(action)
    if len(result) != 5:
        raise ValueError(
            f"step returned {len(result)} values: expected observation, reward, terminated, truncated and info"
        )
    observation, reward, terminated, truncated, info = result
    flags = [bool(_number(name, value)) for name, value in (("terminated", terminated), ("truncated", truncated))]
    return observation, _number("reward", reward), flags[0], flags[1], info


def _number(name: str, value: Any) -> float:
    number = np.asarray(value)
    if number.size != 1 or number.dtype.kind not in "biuf":
        raise ValueError(f"step returned {name}={value!r}: expected one number, or True or False")
    return float(number.item())


def _require_separate(envs: Sequence[gymnasium.Env]) -> None:
    """Raise a `ValueError` unless each environment is a single one with a state of its own."""
    for env in envs:
        if isinstance(env, gymnasium.vector.VectorEnv):
            raise ValueError(
                f"make returned a {type(env).__name__}, which holds several environments: expected a single one, of "
                "which num_envs copies are made"
            )
    if len({id(env.unwrapped) for env in envs}) < len(envs):
        raise ValueError(
            f"make returned the same {type(envs[0].unwrapped).__name__} twice: expected a new environment at each "
            "call, because every copy has a state of its own"
        )
