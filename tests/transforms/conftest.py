"""A batched environment that emits what styles need and nothing else, shared by the tests of the transforms."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from coachable.styles import Choice, Setpoint, SetpointTolerance, StyleReward, StyleSpace, Term, Weight, WeightedFeature


class FeaturesEnv(EnvBase):
    """N independent streams of random features; an episode ends with probability `p_done` per step.

    With `rewards_apart` the task reward is declared as a reward (absent at reset), otherwise as an observation. With
    `nested` the style features are declared as a nested entry, which is refused before anything is emitted.
    """

    def __init__(
        self, num_envs: int = 4, p_done: float = 0.2, rewards_apart: bool = False, nested: bool = False
    ) -> None:
        super().__init__(batch_size=[num_envs])
        self.p_done, self.rewards_apart = p_done, rewards_apart
        shape = (num_envs,)
        features = Unbounded((num_envs, 3))
        if nested:
            features = Composite(values=Unbounded((num_envs, 3)), shape=shape)
        self.observation_spec = Composite(observation=Unbounded((num_envs, 2)), style_features=features, shape=shape)
        # Bounded, as a domain's task reward may be: adding the style reward leaves the bounds.
        rewards = {"reward": Bounded(0, 1, (num_envs, 1))}
        if rewards_apart:
            rewards["task_reward"] = Bounded(0, 1, (num_envs, 1))
        else:
            self.observation_spec["task_reward"] = Bounded(0, 1, (num_envs, 1))
        self.reward_spec = Composite(rewards, shape=shape)
        self.action_spec = Bounded(-1, 1, (num_envs, 1))
        flags = {name: Binary(1, (num_envs, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=shape)
        self.generator = torch.Generator()
        self._set_seed(0)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _rand(self, width: int) -> torch.Tensor:
        return torch.rand(*self.batch_size, width, generator=self.generator)

    def _emit(self) -> TensorDict:
        return TensorDict({"style_features": self._rand(3), "observation": self._rand(2)}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        out = self._emit()
        return out if self.rewards_apart else out.set("task_reward", torch.zeros(*self.batch_size, 1))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out, reward = self._emit(), self._rand(1)
        terminated = self._rand(1) < self.p_done
        out.update({"reward": reward, "task_reward": reward.clone(), "terminated": terminated})
        return out.update({"done": terminated.clone(), "truncated": torch.zeros_like(terminated)})


def _make_space() -> StyleSpace:
    return StyleSpace(
        [Choice("pose", ("a", "b")), Setpoint("length", 0.3, 0.65, unit="m"), Weight("fuel", -3.0, 105.0)]
    )


@pytest.fixture
def space() -> StyleSpace:
    """A choice, a set-point and a weight; theta has 4 entries."""
    return _make_space()


@pytest.fixture
def make_style_reward() -> Callable[..., StyleReward]:
    """Makes the reward of `space` for `FeaturesEnv`."""

    def make(space: StyleSpace) -> StyleReward:
        def pose(features: torch.Tensor, style: Any) -> torch.Tensor:
            return style["pose"][..., 0] * features[..., 0] + style["pose"][..., 1] * features[..., 2].sqrt()

        terms = {
            "pose": Term(pose, parameters=("pose",)),
            "length": SetpointTolerance("length", 1, margin=0.05),
            "fuel": WeightedFeature("fuel", 2),
        }
        return StyleReward(space, terms, scales={"length": 1 / 3, "fuel": -0.01})

    return make


@pytest.fixture
def make_base_env() -> Callable[..., FeaturesEnv]:
    """Makes a `FeaturesEnv`."""
    return FeaturesEnv
