"""`StyleFeatures`, which adds task reward and style features to an environment that has none."""

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from coachable.keys import STYLE_FEATURES, TASK_REWARD


class StyleFeatures(Transform):
    """Environment transform that copies the reward to `task_reward` and writes `style_features`.

    Args:
        features: Maps the tensordict after a step, of batch shape `(...)`, to features `(..., size)`.
        size: Number of features.

    Raises:
        ValueError: At a step, if the features have another shape.

    Example:
        >>> from torchrl.envs import PendulumEnv, TransformedEnv
        >>> env = TransformedEnv(PendulumEnv(), StyleFeatures(lambda after: after["th"].unsqueeze(-1), 1))
        >>> env.rollout(3)["next", "style_features"].shape
        torch.Size([3, 1])
    """

    def __init__(self, features: Callable[[TensorDictBase], Tensor], size: int) -> None:
        super().__init__()
        self.features, self.size = features, size

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict[TASK_REWARD] = next_tensordict["reward"].float()
        features = self.features(next_tensordict).float()
        expected = (*next_tensordict.batch_size, self.size)
        if features.shape != expected:
            raise ValueError(f"the style features have the shape {tuple(features.shape)}: expected {expected}")
        next_tensordict[STYLE_FEATURES] = features
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for key, width in ((TASK_REWARD, 1), (STYLE_FEATURES, self.size)):
            tensordict_reset[key] = torch.zeros(*tensordict_reset.batch_size, width, device=tensordict_reset.device)
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add both keys."""
        for key, width in ((TASK_REWARD, 1), (STYLE_FEATURES, self.size)):
            shape = torch.Size((*observation_spec.shape, width))
            observation_spec[key] = Unbounded(shape=shape, device=observation_spec.device)
        return observation_spec
