"""`StyleRewardTransform`: adds the style part to the task reward of an environment."""

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from coachable import keys
from coachable.styles.reward import StyleReward


class StyleRewardTransform(Transform):
    """Writes `reward = task_reward + style_reward(style_features, theta)`, theta being the style that the policy saw.

    The sum is the one that relabelling computes from stored transitions, bit for bit. The style part is also written, as
    `style_reward`, beside the task reward.

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
        value = self.style_reward(next_tensordict.get(self.features_key), tensordict.get(self.style_key))
        next_tensordict.set(self.style_reward_key, value)
        return next_tensordict.set(self.reward_key, next_tensordict.get(self.task_reward_key) + value)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        task_reward = tensordict_reset.get(self.task_reward_key, None)
        if task_reward is not None:  # the task reward is an observation: so is the style reward, zero at reset
            tensordict_reset.set(self.style_reward_key, torch.zeros_like(task_reward))
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds the style reward if the task reward is declared as an observation."""
        return self._beside_task_reward(observation_spec)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Lifts bounds of the task reward, and adds the style reward if the task reward is declared as a reward."""
        reward_spec = self._beside_task_reward(reward_spec)
        spec = reward_spec[self.reward_key]
        reward_spec[self.reward_key] = Unbounded(shape=spec.shape, dtype=spec.dtype, device=spec.device)
        return reward_spec

    def _beside_task_reward(self, spec: TensorSpec) -> TensorSpec:
        if isinstance(spec, Composite) and self.task_reward_key in spec.keys(True, True):
            task = spec[self.task_reward_key]
            spec[self.style_reward_key] = Unbounded(shape=task.shape, dtype=torch.float32, device=task.device)
        return spec
