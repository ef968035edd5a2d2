"""`StyleRewardTransform`, which adds the style part to the task reward of an environment."""

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from coachable.keys import STYLE, STYLE_FEATURES, STYLE_REWARD, TASK_REWARD
from coachable.styles.reward import StyleReward

_EXPECTED = (
    f"StyleRewardTransform expects {TASK_REWARD} and {STYLE_FEATURES}; add them (coachable.transforms.StyleFeatures), "
    "or rename yours (torchrl.envs.RenameTransform)."
)


class StyleRewardTransform(Transform):
    """Environment transform that writes `reward = task_reward + style_reward(style_features, theta)`.

    Theta is the style that the policy read. Relabelling computes the same sum from stored transitions, bit for bit. The
    style part is also written as `style_reward`, and its spec is beside that of the task reward.

    Args:
        style_reward: Style reward of the domain.

    Raises:
        KeyError: If the environment declares no `task_reward`, or a step emits no `task_reward`, `style_features` or
            style.
        ValueError: If the environment declares nested `style_features`, or a step emits features or a task reward that
            do not have the environment's batch shape and a last dimension.
    """

    def __init__(self, style_reward: StyleReward) -> None:
        super().__init__(in_keys=[TASK_REWARD, STYLE_FEATURES], out_keys=["reward", STYLE_REWARD])
        self.style_reward = style_reward

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        theta = tensordict.get(STYLE, None)
        features = next_tensordict.get(STYLE_FEATURES, None)
        task_reward = next_tensordict.get(TASK_REWARD, None)
        if theta is None:
            raise KeyError(
                f"step got no {STYLE}, only {_listed(tensordict.keys())}: "
                "put a StyleSampler before StyleRewardTransform, and keep its key in the tensordict."
            )
        if features is None or task_reward is None:
            raise KeyError(f"after a step the environment emitted {_listed(next_tensordict.keys())}: {_EXPECTED}")
        if features.shape[:-1] != theta.shape[:-1]:  # terms would broadcast features (N,) silently
            raise ValueError(f"{STYLE_FEATURES} is {_shape(features)}: expected {_shape(theta[..., 0], 'F')}")
        value = self.style_reward(features, theta)
        if task_reward.shape != value.shape:
            raise ValueError(f"{TASK_REWARD} is {_shape(task_reward)}: expected {_shape(value)}")
        next_tensordict.set(STYLE_REWARD, value)
        return next_tensordict.set("reward", task_reward + value)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        task_reward = tensordict_reset.get(TASK_REWARD, None)
        if task_reward is not None:  # then both are observations, and the style reward is 0 at reset
            tensordict_reset.set(STYLE_REWARD, torch.zeros_like(task_reward, dtype=torch.float32))
        return tensordict_reset

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Add the style reward beside the task reward.

        Raises:
            KeyError: If the environment declares no task reward.
            ValueError: If the style features are nested.
        """
        declared = {**output_spec["full_observation_spec"], **output_spec["full_reward_spec"]}
        if TASK_REWARD not in declared:
            raise KeyError(f"the specs of the environment declare {_listed(declared)}: {_EXPECTED}")
        if isinstance(features := declared.get(STYLE_FEATURES), Composite):
            raise ValueError(
                f"the specs of the environment declare {STYLE_FEATURES} with the entries {_listed(features.keys())}: "
                "expected one tensor (..., F); concatenate them (torchrl.envs.CatTensors)."
            )
        out = super().transform_output_spec(output_spec)
        reward = out["full_reward_spec"]["reward"]
        # Style rewards are float32.
        dtype = torch.promote_types(declared[TASK_REWARD].dtype, torch.float32)
        out["full_reward_spec"]["reward"] = reward.to(dtype)
        return out

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the style reward if the task reward is declared as an observation."""
        return self._beside_task_reward(observation_spec)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Remove the bounds of the reward, and add the style reward if the task reward is declared as a reward."""
        spec = reward_spec["reward"]
        reward_spec["reward"] = Unbounded(shape=spec.shape, dtype=spec.dtype, device=spec.device)
        return self._beside_task_reward(reward_spec)

    def _beside_task_reward(self, spec: Composite) -> Composite:
        if TASK_REWARD in spec.keys(True, True):
            task = spec[TASK_REWARD]
            spec[STYLE_REWARD] = Unbounded(shape=task.shape, dtype=torch.float32, device=task.device)
        return spec


def _shape(tensor: Tensor, *further: str) -> str:
    return f"({', '.join([*map(str, tensor.shape), *further])}{',' if tensor.ndim + len(further) == 1 else ''})"


def _listed(keys: Iterable[NestedKey]) -> str:
    return ", ".join(sorted(map(str, keys)))
