"""Policies over mixed discrete-continuous actions in one tensor (Appendices B and C)."""

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
from coachable.networks.actors import StyleEncoding, StyleNetwork, TensorModule


class MixedPolicy(StyleNetwork):
    """Network of the probabilities of the categorical heads, and of location and scale of the axes.

    The trunk's input is `cat(observation, encode(theta))`. Heads run in float32, also under autocast. The scale of the
    axes is `exp(2 tanh(raw))` (paper). Their location is unbounded, and its tanh is the deterministic action.

    Args:
        obs_dim: Width of the observation.
        heads: Components of the action.
        space: Style space that encodes theta; None for a policy without style.
        widths: Widths of the residual layers.
        **trunk: Further arguments of `ResidualMLP`.
    """

    def __init__(
        self,
        obs_dim: int,
        heads: ActionHeads,
        space: StyleEncoding | None,
        widths: Sequence[int],
        **trunk: Any,
    ) -> None:
        super().__init__(space, obs_dim, heads.num_parameters, widths, **trunk)
        self.heads = heads

    def forward(self, observation: Tensor, style: Tensor | None = None) -> tuple[Tensor, ...]:
        """Return the parameters of the action's distribution.

        Args:
            observation: Observation `(..., obs_dim)`.
            style: Raw style `(..., d)`, encoded here; None without a style space.

        Returns:
            `probs` `(..., sum of head sizes)` if there are categorical heads, by regret matching (paper, Appendix B),
            then `loc` and `scale` `(..., axes)` if there are axes, all float32. The scale is `exp(2 tanh(raw))`.

        Raises:
            ValueError: If the network has a style space and `style` is None.
        """
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
        heads: Components of the action, or the arguments of `ActionHeads` as a mapping, for configuration files.
        space: Style space that encodes theta, which is read from the key `style`; None for no style.
        widths: Widths of the residual layers.
        **trunk: Further arguments of `ResidualMLP`.

    Returns:
        A `ProbabilisticActor` that reads `observation` and `style`. It writes `action` with hard one-hots, `probs` with
        categorical heads, and `loc` and `scale` with axes. By default (see `set_exploration_type`) an actor with
        categorical heads samples its actions, because their modes would never include rare actions such as dodging.
        An actor with axes alone takes the deterministic action.

    Example:
        >>> actor = make_mixed_actor(3, ActionHeads((4, 2), axes=1), None, widths=(8,))
        >>> actor.out_keys
        ['probs', 'loc', 'scale', 'action']
    """
    heads = heads if isinstance(heads, ActionHeads) else ActionHeads(**heads)
    names: list[Any] = (["probs"] if heads.categorical else []) + (["loc", "scale"] if heads.axes else [])
    policy = MixedPolicy(obs_dim, heads, space, widths, **trunk)
    return ProbabilisticActor(
        TensorModule(policy, in_keys=policy.in_keys("observation"), out_keys=names),
        in_keys=names,
        spec=heads.spec(),
        distribution_class=MixedAction,
        distribution_kwargs={"heads": heads},
        default_interaction_type=InteractionType.RANDOM if heads.categorical else InteractionType.DETERMINISTIC,
    )
