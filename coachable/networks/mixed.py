"""Policies over mixed discrete-continuous actions, one action tensor each (Appendices B and C)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict.nn import InteractionType
from torch import Tensor
from torchrl.modules import ProbabilisticActor

from coachable.distributions.action_heads import ActionHeads
from coachable.distributions.categorical import regret_matching_probabilities
from coachable.distributions.mixed_action import MixedAction
from coachable.distributions.tanh_gaussian import at_least_float32
from coachable.keys import STYLE
from coachable.networks.actors import StyleEncoding, StyleNetwork, TensorModule


class MixedPolicy(StyleNetwork):
    """Probabilities of the categorical heads, location and scale of the axes, given observation and style.

    The trunk sees `cat(observation, encode(theta))`. Heads run in float32, also under autocast. The scale of the axes
    is `exp(2 tanh(raw))` (paper), their location is unbounded and its tanh is the deterministic action.

    Args:
        obs_dim: Width of the observation.
        heads: Components of the action.
        space: Style space whose `encode` is applied to theta; None for a policy without style.
        widths: Widths of the residual layers.
        **trunk: Further arguments of `ResidualMLP`.
    """

    def __init__(
        self,
        obs_dim: int,
        heads: ActionHeads,
        space: StyleEncoding | None,
        widths: Sequence[int] = (512, 512, 512),
        **trunk: Any,
    ) -> None:
        super().__init__(space, obs_dim, heads.num_parameters, widths, **trunk)
        self.heads = heads

    def forward(self, observation: Tensor, style: Tensor | None = None) -> tuple[Tensor, ...]:
        """Return `probs` if there are categorical heads, then `loc` and `scale` if there are axes, float32."""
        raw = at_least_float32(self.head(observation, style))
        preferences, loc, raw_scale = raw.split((self.heads.num_categorical, self.heads.axes, self.heads.axes), -1)
        outputs: tuple[Tensor, ...] = ()
        if self.heads.categorical:
            outputs += (regret_matching_probabilities(preferences, self.heads.layout),)
        if self.heads.axes:
            outputs += (loc, torch.exp(2.0 * torch.tanh(raw_scale)))
        return outputs


def make_mixed_actor(
    obs_dim: int,
    heads: ActionHeads | Mapping[str, Any],
    space: StyleEncoding | None,
    widths: Sequence[int] = (512, 512, 512),
    **trunk: Any,
) -> ProbabilisticActor:
    """Build the policy of RAC and Cat-RAC.

    Args:
        obs_dim: Width of the observation.
        heads: Components of the action, or the arguments of `ActionHeads`, as a configuration file has them; also
            works with only axes or only categorical heads.
        space: Style space; theta is read from the key `style` and encoded inside. None for no style.
        widths: Widths of the residual layers.
        **trunk: Further arguments of `ResidualMLP`.

    Returns:
        A `ProbabilisticActor` reading `observation` and `style`, writing `probs`, `loc`, `scale` (those that exist)
        and `action`, with hard one-hots. Unless told otherwise (`set_exploration_type`) it samples its actions where
        it has categorical heads, as in training: at their modes it would never do what is right now and then, such as
        dodging. With axes alone it takes the deterministic action.

    Example:
        >>> actor = make_mixed_actor(3, ActionHeads((4, 2), axes=1), None, widths=(8,))
        >>> actor.out_keys
        ['probs', 'loc', 'scale', 'action']
    """
    heads = heads if isinstance(heads, ActionHeads) else ActionHeads(**heads)
    names: list[Any] = (["probs"] if heads.categorical else []) + (["loc", "scale"] if heads.axes else [])
    in_keys: list[Any] = ["observation"] if space is None else ["observation", STYLE]
    return ProbabilisticActor(
        TensorModule(MixedPolicy(obs_dim, heads, space, widths, **trunk), in_keys=in_keys, out_keys=names),
        in_keys=names,
        spec=heads.spec(),
        distribution_class=MixedAction,
        distribution_kwargs={"heads": heads},
        default_interaction_type=InteractionType.RANDOM if heads.categorical else InteractionType.DETERMINISTIC,
    )
