"""Policies as plain functions of tensors, for export and explanation."""

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from coachable.distributions.categorical import EPSILON
from coachable.networks.actors import GaussianPolicy
from coachable.networks.mixed import MixedPolicy

_SCALE = 2.0**20  # cancels; without it the exporter rounds EPSILON to 0, and a head without preferences is 0 / 0


def policy_network(actor: TensorDictModuleBase) -> GaussianPolicy | MixedPolicy:
    """Return the network inside an actor.

    Raises:
        ValueError: If the actor does not contain exactly one `GaussianPolicy` or `MixedPolicy` that reads a style.
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
        """Return the axes after the tanh and the probabilities per head, from the trunk's output.

        This uses only elementary operations, because the regret gradient's function supports neither export nor
        derivatives.
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
    """Deterministic action of a policy as a function `(observation, style)`, where `style` is not encoded.

    The probabilities of categorical heads are returned as well, because policies of mixed actions sample from them.

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
        """Return the outputs in the order of `output_names`.

        Args:
            observation: Observations `(..., observation_dim)`.
            style: Styles `(..., style_dim)`, not encoded.

        Returns:
            `action` `(..., A)` in [-1, 1]. For mixed actions, `axes` `(..., axes)` in [-1, 1], `choices` `(..., heads)`
            int64, the index of each head's most likely value, and `probabilities` `(..., sum(choice_sizes))`.
        """
        axes, probabilities = self._parts(self.policy.trunk(observation, self.space.encode(style)))
        outputs = () if axes is None else (axes,)
        if not probabilities:
            return outputs
        return (*outputs, torch.stack([head.argmax(-1) for head in probabilities], -1), torch.cat(probabilities, -1))


class ActionOutputs(_PlainPolicy):
    """Differentiable outputs of a policy as a function of its trunk's input, `cat(observation, encode(theta))`.

    The outputs are the probabilities of the categorical values and the axes after the tanh. The probabilities have
    their true derivative, which training replaces by the regret gradient.

    Args:
        actor: From `make_gaussian_actor` or `make_mixed_actor`; its weights are shared.
    """

    def forward(self, inputs: Tensor) -> Tensor:
        """Map `(B, observation_dim + style_dim)` to `(B, outputs)`."""
        axes, probabilities = self._parts(self.policy.trunk(inputs))
        return torch.cat([*probabilities, *(() if axes is None else (axes,))], -1)
