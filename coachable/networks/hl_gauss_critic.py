"""Critics whose value is a distribution over HL-Gauss bins."""

from collections.abc import Sequence
from typing import Any

from torchrl.modules import ValueOperator

from coachable.distributions.hl_gauss import HLGauss, initialise_value
from coachable.networks.actors import StyleEncoding
from coachable.networks.critics import make_critic


def make_hl_gauss_critic(
    obs_dim: int,
    action_dim: int,
    space: StyleEncoding | None,
    widths: Sequence[int] = (512, 512, 512),
    *,
    v_min: float = -600.0,
    v_max: float = 1000.0,
    num_atoms: int = 255,
    initial_value: float | None = 0.0,
    **options: Any,
) -> ValueOperator:
    """Build one categorical critic, whose `state_action_value` holds the logits over the bins.

    Args:
        obs_dim: Width of the observation.
        action_dim: Width of the action (for mixed actions `ActionHeads.action_dim`).
        space: Style space that encodes theta, which is read from the key `style`; None for no style.
        widths: Widths of the residual layers.
        v_min: Smallest value represented; it, `v_max` and `num_atoms` must equal those of the loss.
        v_max: Largest value represented.
        num_atoms: Number of bins.
        initial_value: Prediction before training, see `initialise_value`; None for the usual initialisation, which
            predicts the middle of the support.
        **options: Further arguments of `make_critic`.

    Returns:
        A `ValueOperator` that reads `observation`, `action` and `style` and writes `state_action_value`
        (..., num_atoms).

    Raises:
        ValueError: If the support is empty, or `initial_value` lies outside it.
    """
    bins = HLGauss(v_min, v_max, num_atoms)
    critic = make_critic(obs_dim, action_dim, space, widths, num_outputs=bins.num_atoms, **options)
    initialise_value(critic, bins, initial_value)
    return critic
