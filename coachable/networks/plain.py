"""Policies as plain functions of two tensors, for export and explanation."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from coachable.distributions.categorical import EPSILON
from coachable.networks.actors import GaussianPolicy
from coachable.networks.mixed import MixedPolicy

__all__ = ["ActionOutputs", "DeterministicAction", "policy_network"]

_SCALE = 2.0**20  # cancels out; without it the exporter takes EPSILON for 0, and a head without preferences for 0 / 0


def policy_network(actor: TensorDictModuleBase) -> GaussianPolicy | MixedPolicy:
    """The network inside an actor.

    Raises:
        ValueError: If the actor holds no `GaussianPolicy` or `MixedPolicy` that reads a style.
    """
    found = [module for module in actor.modules() if isinstance(module, GaussianPolicy | MixedPolicy)]
    styled = [module for module in found if module.space is not None]
    if len(styled) != 1:
        raise ValueError(
            f"{type(actor).__name__} holds {len(styled)} policies that read a style: expected one, as made by "
            "coachable.networks.make_gaussian_actor or make_mixed_actor"
        )
    return styled[0]


class _PlainPolicy(nn.Module):
    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.policy = policy_network(actor)
        space: Any = self.policy.space
        self.space = space
        self.style_dim = int(space.dim)
        self.observation_dim = self.policy.trunk.in_features - self.style_dim

    def _parts(self, raw: Tensor) -> tuple[Tensor | None, tuple[Tensor, ...]]:
        """Axes after the tanh, and probabilities per head, from the trunk's output.

        By elementary operations, because neither exporters nor derivatives get past the regret gradient's function.
        """
        if isinstance(self.policy, GaussianPolicy):
            return torch.tanh(raw.chunk(2, -1)[0]), ()
        heads = self.policy.heads
        preferences, loc, _ = raw.split((heads.num_categorical, heads.axes, heads.axes), -1)
        probabilities = ()
        if heads.categorical:
            positive = [
                _SCALE * head.clamp(min=0.0) + _SCALE * EPSILON / head.shape[-1]
                for head in preferences.split(heads.categorical, -1)
            ]
            probabilities = tuple(head / head.sum(-1, keepdim=True) for head in positive)
        return (torch.tanh(loc) if heads.axes else None), probabilities


class DeterministicAction(_PlainPolicy):
    """`(observation, style)` to the deterministic action, style raw and encoded inside.

    Categorical heads also give their probabilities: policies of mixed actions act by sampling them.

    Args:
        actor: From `make_gaussian_actor` or `make_mixed_actor`; its weights are shared.

    Attributes:
        output_names: `("action",)`; for mixed actions `axes`, and `choices` and `probabilities`, those that exist.
        choice_sizes: Number of values of each head of `choices`.

    Example:
        >>> from coachable.networks import make_gaussian_actor
        >>> from coachable.styles import StyleSpace, Weight
        >>> plain = DeterministicAction(make_gaussian_actor(3, 2, StyleSpace([Weight("calm", 0, 1)]), widths=(8,)))
        >>> plain(torch.zeros(5, 3), torch.zeros(5, 1))[0].shape
        torch.Size([5, 2])
    """

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__(actor)
        self.output_names: tuple[str, ...] = ("action",)
        self.choice_sizes: tuple[int, ...] = ()
        if isinstance(self.policy, MixedPolicy):
            heads = self.policy.heads
            self.output_names = ("axes",) if heads.axes else ()
            self.output_names += ("choices", "probabilities") if heads.categorical else ()
            self.choice_sizes = heads.categorical

    def forward(self, observation: Tensor, style: Tensor) -> tuple[Tensor, ...]:
        """Outputs in the order of `output_names`.

        Args:
            observation: `(..., observation_dim)`.
            style: `(..., style_dim)`, raw.

        Returns:
            `action` `(..., A)` in [-1, 1]; or `axes` `(..., axes)` in [-1, 1] and `choices` `(..., heads)` int64, the
            index of each head's most likely value, and `probabilities` `(..., sum(choice_sizes))`, head after head.
        """
        axes, probabilities = self._parts(self.policy.trunk(observation, self.space.encode(style)))
        outputs = () if axes is None else (axes,)
        if not probabilities:
            return outputs
        return (*outputs, torch.stack([head.argmax(-1) for head in probabilities], -1), torch.cat(probabilities, -1))


class ActionOutputs(_PlainPolicy):
    """Differentiable account of the action, as a function of what the network sees, `cat(observation, encode(theta))`.

    The axes after the tanh, and the probabilities of the categorical values with their true derivative (training uses
    the regret gradient instead, which is none).

    Args:
        actor: From `make_gaussian_actor` or `make_mixed_actor`; its weights are shared.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """`(B, observation_dim + style_dim)` to `(B, outputs)`."""
        axes, probabilities = self._parts(self.policy.trunk(inputs))
        return torch.cat([*probabilities, *(() if axes is None else (axes,))], -1)
