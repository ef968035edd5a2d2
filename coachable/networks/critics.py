"""Style-conditioned action-value networks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torchrl.modules import ValueOperator

from coachable.networks.actors import StyleEncoding, StyleNetwork, TensorModule


class StyleCritic(StyleNetwork):
    """Network of an action value, its quantiles, or logits over its bins.

    The trunk's input is `cat(observation, encode(theta), action)`. The head has one output for a scalar value, else one
    for each quantile or bin.
    """

    def forward(self, observation: Tensor, action: Tensor, style: Tensor | None = None) -> Tensor:
        """Return the critic's output.

        Args:
            observation: Observation `(..., obs_dim)`.
            action: Action `(..., action_dim)`.
            style: Raw style `(..., d)`, encoded here; None without a style space.

        Returns:
            Output `(..., outputs)` float32.

        Raises:
            ValueError: If the network has a style space and `style` is None.
        """
        return self.head(observation, style, action)


class CriticModule(TensorModule, ValueOperator):
    """`ValueOperator` that writes its tensor without conversion."""


def make_critic(
    obs_dim: int,
    action_dim: int,
    space: StyleEncoding | None,
    widths: Sequence[int] = (512, 512, 512),
    *,
    num_outputs: int = 1,
    **trunk: Any,
) -> ValueOperator:
    """Build one critic.

    Build each critic of a loss by its own call, and pass them as a list. TorchRL would initialise copies of a single
    module again, without the Glorot weights.

    Args:
        obs_dim: Width of the observation.
        action_dim: Width of the action.
        space: Style space that encodes theta, which is read from the key `style`; None for no style.
        widths: Widths of the residual layers.
        num_outputs: 1 for a scalar value, else the number of quantiles or logits.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.

    Returns:
        A `ValueOperator` that reads `observation`, `action` and `style` and writes `state_action_value`.
    """
    critic = StyleCritic(space, obs_dim + action_dim, num_outputs, widths, **trunk)
    return CriticModule(critic, in_keys=critic.in_keys("observation", "action"), out_keys=["state_action_value"])
