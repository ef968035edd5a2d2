"""`StyleRewardTransform`: adds the style part to the task reward of an environment."""

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from coachable import keys
from coachable.styles.reward import StyleReward


class StyleRewardTransform(Transform):
    """Writes `reward = task_reward + style_reward(style_features, theta)`, theta being the style that the policy saw.

    The sum is the one that relabelling computes from stored transitions, bit for bit. The style part is also written,
    as `style_reward`, and declared where the task reward is declared (as a reward or as an observation).

    Args:
        style_reward: The only code that computes style rewards.
        style_key: Key of theta, in the tensordict given to `step`.
        features_key: Key of the features, in its `next`.
        task_reward_key: Key of the task reward, in its `next`.
        reward_key: Key to write the sum to.
        style_reward_key: Key to write the style part to.
    """

    def __init__(
        self,
        style_reward: StyleReward,
        style_key: NestedKey = keys.STYLE,
        features_key: NestedKey = keys.STYLE_FEATURES,
        task_reward_key: NestedKey = keys.TASK_REWARD,
        reward_key: NestedKey = "reward",
        style_reward_key: NestedKey = keys.STYLE_REWARD,
    ) -> None:
        super().__init__(in_keys=[task_reward_key, features_key], out_keys=[reward_key, style_reward_key])
        self.style_reward = style_reward
        self.style_key = style_key
        self.features_key = features_key
        self.task_reward_key = task_reward_key
        self.reward_key = reward_key
        self.style_reward_key = style_reward_key

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        theta = tensordict.get(self.style_key, None)
        features = next_tensordict.get(self.features_key, None)
        task_reward = next_tensordict.get(self.task_reward_key, None)
        if theta is None or features is None or task_reward is None:
            raise KeyError(self._what_is_missing(tensordict, next_tensordict))
        value = self.style_reward(features, theta)
        next_tensordict.set(self.style_reward_key, value)
        return next_tensordict.set(self.reward_key, task_reward + value)

    def _what_is_missing(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> str:
        def listed(keys: Iterable[NestedKey]) -> str:
            return ", ".join(sorted(map(str, keys)))

        if self.style_key not in tensordict.keys(True):
            return (
                f"step got no {self.style_key}, only {listed(tensordict.keys())}: "
                "put a StyleSampler before StyleRewardTransform, and keep its key in the tensordict."
            )
        return (
            f"after a step the environment emitted {listed(next_tensordict.keys())}: StyleRewardTransform expects "
            f"{self.task_reward_key} and {self.features_key}; emit them, or name yours in its arguments."
        )

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        task_reward = tensordict_reset.get(self.task_reward_key, None)
        if task_reward is not None:  # the task reward is an observation: so is the style reward, zero at reset
            tensordict_reset.set(self.style_reward_key, torch.zeros_like(task_reward))
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the style reward if the task reward is declared as an observation."""
        return self._beside_task_reward(observation_spec)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Lifts bounds of the task reward, and adds the style reward if the task reward is declared as a reward."""
        spec = reward_spec[self.reward_key]
        reward_spec[self.reward_key] = Unbounded(shape=spec.shape, dtype=spec.dtype, device=spec.device)
        return self._beside_task_reward(reward_spec)

    def _beside_task_reward(self, spec: Composite) -> Composite:
        if self.task_reward_key in spec.keys(True, True):
            task = spec[self.task_reward_key]
            spec[self.style_reward_key] = Unbounded(shape=task.shape, dtype=torch.float32, device=task.device)
        return spec
