"""Specs of environments that emit an observation, a task reward and style features."""

from collections.abc import Mapping

import torch
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from coachable.keys import STYLE_FEATURES, TASK_REWARD


def set_specs(
    env: EnvBase,
    *,
    action: TensorSpec,
    observation: int,
    style_features: int,
    further: Mapping[str, int | TensorSpec] | None = None,
) -> None:
    """Set the specs of an environment whose rewards and flags `done`, `terminated` and `truncated` are (N, 1).

    Args:
        env: Environment of batch size (N,).
        action: Spec of its actions (N, A).
        observation: Width of `observation`.
        style_features: Width of `style_features`.
        further: Further entries that a step emits: the width of a float32 tensor, or a spec.
    """

    def of_width(width: int) -> Unbounded:
        return Unbounded(torch.Size((*env.batch_size, width)), dtype=torch.float32, device=env.device)

    widths = {"observation": observation, TASK_REWARD: 1, STYLE_FEATURES: style_features, **(further or {})}
    entries = {name: of_width(width) if isinstance(width, int) else width for name, width in widths.items()}
    column = torch.Size((*env.batch_size, 1))
    flag = Binary(1, column, dtype=torch.bool, device=env.device)
    flags = {name: flag.clone() for name in ("done", "terminated", "truncated")}
    env.action_spec = action
    env.observation_spec = Composite(entries, shape=env.batch_size, device=env.device)
    env.reward_spec = of_width(1)
    env.done_spec = Composite(flags, shape=env.batch_size, device=env.device)
