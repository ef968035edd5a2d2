"""Networks: padded residual trunks, style-conditioned actors and critics."""

from coachable.networks.actors import make_gaussian_actor
from coachable.networks.critics import make_critic
from coachable.networks.residual import ResidualBlock, ResidualMLP, fit_features

__all__ = ["ResidualBlock", "ResidualMLP", "fit_features", "make_critic", "make_gaussian_actor"]
