"""Networks: padded residual trunks, and style-conditioned actors and critics."""

from coachable.distributions.action_heads import ActionHeads
from coachable.networks.actors import make_gaussian_actor
from coachable.networks.critics import make_critic
from coachable.networks.hl_gauss_critic import make_hl_gauss_critic
from coachable.networks.mixed import make_mixed_actor
from coachable.networks.residual import ResidualBlock, ResidualMLP, fit_features

__all__ = [
    "ActionHeads",
    "ResidualBlock",
    "ResidualMLP",
    "fit_features",
    "make_critic",
    "make_gaussian_actor",
    "make_hl_gauss_critic",
    "make_mixed_actor",
]
