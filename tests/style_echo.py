"""An environment whose style asks for an action, for every kind of action; losses must learn to echo it."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from coachable.distributions.action_heads import ActionHeads
from coachable.keys import STYLE_FEATURES, TASK_REWARD
from coachable.styles import Setpoint, StyleReward, StyleSpace, Term
from coachable.transforms import CoachableEnv, coachable_env

LEVELS = 3  # values of a categorical head, evenly spaced over [-1, 1]
STEPS = 4  # truncated, never terminated

HEADS = {
    "continuous": ActionHeads(axes=1),
    "discrete": ActionHeads(categorical=(LEVELS,)),
    "mixed": ActionHeads(categorical=(LEVELS,), axes=1),
}


def levels_and_axes(action: Tensor, heads: ActionHeads) -> Tensor:
    """What each component of the action says, `(..., heads + axes)` in [-1, 1]: the level chosen, the axis itself."""
    one_hots, axes = heads.split(action)
    levels = torch.linspace(-1, 1, LEVELS).to(action)
    chosen = [(part * levels).sum(-1, keepdim=True) for part in one_hots.split(heads.categorical, -1) if part.numel()]
    return torch.cat([*chosen, axes], -1)


class MixedStyleEchoEnv(EnvBase):
    """N clocks of four steps. The style features are what the action says; there is no task."""

    def __init__(self, heads: ActionHeads, num_envs: int = 64) -> None:
        super().__init__(batch_size=[num_envs])
        self.heads = heads
        shape, components = (num_envs,), len(heads.categorical) + heads.axes
        self.observation_spec = Composite(
            observation=Unbounded((num_envs, 1)),
            **{TASK_REWARD: Unbounded((num_envs, 1)), STYLE_FEATURES: Unbounded((num_envs, components))},
            shape=shape,
        )
        self.action_spec = heads.spec(shape)
        self.reward_spec = Unbounded((num_envs, 1))
        names = ("done", "terminated", "truncated")
        self.done_spec = Composite({name: Binary(1, (num_envs, 1), dtype=torch.bool) for name in names}, shape=shape)
        self.clock = torch.zeros(num_envs, 1)

    def _set_seed(self, seed: int | None) -> None:
        pass  # nothing here is random

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.clock = torch.zeros_like(self.clock) if mask is None else torch.where(mask, 0.0, self.clock)
        return self._package(torch.zeros(*self.batch_size, len(self.heads.categorical) + self.heads.axes))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.clock = self.clock + 1
        out = self._package(levels_and_axes(tensordict["action"], self.heads))
        return out.set("reward", torch.zeros_like(self.clock))

    def _package(self, features: Tensor) -> TensorDictBase:
        truncated = self.clock >= STEPS
        none = torch.zeros_like(self.clock)
        out = {
            "observation": self.clock / STEPS,
            TASK_REWARD: none,
            STYLE_FEATURES: features,
            "terminated": torch.zeros_like(truncated),
            "truncated": truncated,
            "done": truncated.clone(),
        }
        return TensorDict(out, batch_size=self.batch_size)


def echo_space(heads: ActionHeads) -> StyleSpace:
    """One set-point per component of the action."""
    return StyleSpace([Setpoint(f"target_{i}", -1.0, 1.0) for i in range(len(heads.categorical) + heads.axes)])


def make_style_echo_env(heads: ActionHeads, num_envs: int = 64, seed: int = 0) -> CoachableEnv:
    """The environment with its style transforms: reward `-sum_i |a_i - target_i|`."""
    space = echo_space(heads)

    def distance(index: int) -> Any:
        return lambda features, style: -(features[..., index] - style[f"target_{index}"]).abs()

    terms = {name: Term(distance(i), parameters=(name,)) for i, name in enumerate(space.names)}
    return coachable_env(MixedStyleEchoEnv(heads, num_envs), space, StyleReward(space, terms), seed=seed)
