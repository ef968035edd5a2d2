"""`StyleWrapper`: a Gymnasium environment that shows a style and rewards following it."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike
from torch import Tensor

from coachable.gym.checked_features import Features, checked_features, flat_observation
from coachable.keys import STYLE, STYLE_REWARD, TASK_REWARD
from coachable.styles import StyleReward
from coachable.transforms.style_sampler import derive_seed


class StyleWrapper(gymnasium.Wrapper, RecordConstructorArgs):
    """Coachable Gymnasium environment, which shows a style, drawn anew for each episode, and rewards following it.

    The reward of a step is the sum of the environment's reward and the reward of the style in the observation before
    the step. The info contains `style` (the one in the returned observation), and after a step `task_reward` and
    `style_reward`. The style is raw theta; you may have to normalise it for networks that do not encode it.

    Args:
        env: A Gymnasium environment. If its observation is a Dict or a Tuple, `flat` has to be set, because few agents
            read a Dict inside a Dict.
        style_reward: Reward for following a style, with its `StyleSpace`.
        features: Function that computes the inputs of the reward's terms, see `Features`.
        flat: Whether to observe one vector, `cat(flattened observation, style)`, instead of the Dict
            `{observation, style}`.

    Raises:
        ValueError: If the observation is a Dict or a Tuple and `flat` is not set, or if it has no fixed size and `flat`
            is set.

    Example:
        >>> from coachable.styles import StyleSpace, Weight, WeightedFeature
        >>> space = StyleSpace([Weight("effort", -1.0, 1.0)])
        >>> reward = StyleReward(space, {"effort": WeightedFeature("effort", 0)})
        >>> env = StyleWrapper(gymnasium.make("Pendulum-v1"), reward, lambda obs, action, info: -np.square(action))
        >>> env.set_style({"effort": 0.5})
        >>> observation, info = env.reset(seed=0)
        >>> observation["observation"].shape, observation["style"]
        ((3,), array([0.5], dtype=float32))
    """

    def __init__(
        self, env: gymnasium.Env, style_reward: StyleReward, features: Features, *, flat: bool = False
    ) -> None:
        _check_observation(env.observation_space, flat)
        RecordConstructorArgs.__init__(
            self, _disable_deepcopy=True, style_reward=style_reward, features=features, flat=flat
        )
        gymnasium.Wrapper.__init__(self, env)
        self.space = style_reward.space
        self.style_reward = style_reward
        self.features = features
        self.flat = flat
        style = spaces.Box(self.space.low.numpy(), self.space.high.numpy(), dtype=np.float32)
        if flat:
            inner = spaces.flatten_space(env.observation_space)
            assert isinstance(inner, spaces.Box)
            dtype = self._flat_dtype = np.result_type(inner.dtype, np.float32)
            low, high = np.append(inner.low, style.low), np.append(inner.high, style.high)
            self.observation_space = spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype.type)
        else:
            self.observation_space = spaces.Dict({"observation": env.observation_space, STYLE: style})
        self._generator = torch.Generator()
        self._generator.seed()
        self._held: Tensor | None = None
        self._style = self.space.default  # of the last observation

    def set_style(self, style: Mapping[str, float | str] | ArrayLike | None, strict: bool = False) -> None:
        """Request a style from the next observation on, also in later episodes.

        Args:
            style: Values by name (other parameters have their default), or raw theta `(dim,)`; None draws styles again
                from the next episode on.
            strict: Whether to raise instead of clamping to the trained range with a warning.

        Raises:
            ValueError: If a name is unknown, a shape wrong, a value NaN, or `strict` and out of range.
        """
        if style is None:
            self._held = None
        elif isinstance(style, Mapping):
            self._held = self.space.make(strict=strict, **style)
        else:
            theta = torch.as_tensor(np.array(style, dtype=np.float32))
            if theta.shape != (self.space.dim,):
                raise ValueError(f"style has shape {tuple(theta.shape)}: expected ({self.space.dim},), one style.")
            self._held = self.space.clamp(theta, strict=strict)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode with the style that was set, or else a newly drawn one.

        Args:
            seed: Seed of the environment and of the draws of styles; None to continue both.
            options: Options for the environment.

        Returns:
            Observation as described in the class, and the environment's info with the raw style `(d,)` as "style".
        """
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._generator.manual_seed(derive_seed(seed, STYLE))
        drawn = self.space.sample((), self._generator)  # also where one is held, so that seeded draws stay aligned
        self._style = drawn if self._held is None else self._held
        return self._shown(observation), {**info, STYLE: self._style.numpy().copy()}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make a step and add the reward of the style in the observation before it.

        Returns:
            Observation, the environment's reward plus the style reward, terminated, truncated, and the environment's
            info with the raw style `(d,)` of the next observation, `task_reward` and `style_reward`.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        features = checked_features(self.features(observation, action, info))
        task_reward = float(reward)  # pyright: ignore[reportArgumentType]  # SupportsFloat
        style_reward = self.style_reward(torch.from_numpy(features)[None], self._style[None]).item()
        if self._held is not None:
            self._style = self._held
        info = {**info, STYLE: self._style.numpy().copy(), TASK_REWARD: task_reward, STYLE_REWARD: style_reward}
        return self._shown(observation), task_reward + style_reward, terminated, truncated, info

    def _shown(self, observation: Any) -> Any:
        style = self._style.numpy().copy()
        if not self.flat:
            return {"observation": observation, STYLE: style}
        flattened = flat_observation(self.env.observation_space, observation)
        return np.concatenate([flattened, style]).astype(self._flat_dtype)


def _check_observation(space: spaces.Space, flat: bool) -> None:
    if flat and not space.is_np_flattenable:
        raise ValueError(
            f"the observation space {space} has no fixed size, so flat=True cannot make one vector of it: make it a "
            "Box first, with gymnasium.wrappers.TransformObservation"
        )
    if not flat and isinstance(space, spaces.Dict | spaces.Tuple):
        raise ValueError(
            f"the observation is a {type(space).__name__}, which would lie inside the Dict that holds the style, and "
            "few agents read that: pass flat=True for one vector, or flatten the environment first, with "
            "gymnasium.wrappers.FlattenObservation"
        )
