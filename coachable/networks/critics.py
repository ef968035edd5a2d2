"""Style-conditioned action-value networks."""

from collections.abc import Sequence
from typing import Any, Protocol

from torch import Tensor
from torchrl.modules import ValueOperator

from coachable.networks.actors import StyleEncoding, StyleNetwork, TensorModule


class ActionFeatures(Protocol):
    """Function of the action that a critic sees beside the action itself."""

    width: int

    def __call__(self, action: Tensor, /) -> Tensor:
        """Return features `(..., width)` of actions `(..., action_dim)`, differentiable."""
        ...


class StyleCritic(StyleNetwork):
    """Network of an action value, its quantiles, or logits over its bins.

    The trunk's input is `cat(observation, encode(theta), action, features of the action)`. The head has one output for
    a scalar value, else one for each quantile or bin.

    Args:
        space: Style space that encodes theta; None for no style.
        inputs: Width of observation and action together.
        outputs: Width of the head.
        widths: Widths of the residual layers.
        action_features: Further input computed from the action; None for none.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.
    """

    def __init__(
        self,
        space: StyleEncoding | None,
        inputs: int,
        outputs: int,
        widths: Sequence[int],
        *,
        action_features: ActionFeatures | None = None,
        **trunk: Any,
    ) -> None:
        extra = 0 if action_features is None else action_features.width
        super().__init__(space, inputs + extra, outputs, widths, **trunk)
        self.action_features = action_features

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
        if self.action_features is None:
            return self.head(observation, style, action)
        return self.head(observation, style, action, self.action_features(action))


class CriticModule(TensorModule, ValueOperator):
    """`ValueOperator` that writes its tensor without conversion."""


def make_critic(
    obs_dim: int,
    action_dim: int,
    space: StyleEncoding | None,
    widths: Sequence[int] = (512, 512, 512),
    *,
    num_outputs: int = 1,
    action_features: ActionFeatures | None = None,
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
        action_features: Further input of the critic computed from the action; None for none.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.

    Returns:
        A `ValueOperator` that reads `observation`, `action` and `style` and writes `state_action_value`.
    """
    inputs = obs_dim + action_dim
    critic = StyleCritic(space, inputs, num_outputs, widths, action_features=action_features, **trunk)
    return CriticModule(critic, in_keys=critic.in_keys("observation", "action"), out_keys=["state_action_value"])
