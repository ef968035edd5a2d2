"""Style-conditioned tanh-Gaussian policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor

from coachable.distributions.tanh_normal import TanhGaussian
from coachable.keys import STYLE
from coachable.networks.residual import ResidualMLP


class StyleEncoding(Protocol):
    """What a network needs of a style space (a `StyleSpace` provides it)."""

    @property
    def dim(self) -> int:
        """Width of theta."""
        ...

    def encode(self, theta: Tensor, /) -> Tensor:
        """Scale theta `(..., dim)` to about [-1, 1]."""
        ...


class GaussianPolicy(nn.Module):
    """Mean and scale of a diagonal Gaussian over pre-tanh actions, given observation and style.

    The trunk sees `cat(observation, encode(theta))`. The scale is `exp(l + (h - l)/2 (tanh(raw) + 1))` with
    `log_scale_range=(l, h)`; `(-2, 2)` gives the `exp(2 tanh(raw))` of the paper's RAC.

    Args:
        obs_dim: Width of the observation.
        action_dim: Number of action dimensions.
        space: Style space whose `encode` is applied to theta; `None` makes a policy without style.
        widths: Widths of the residual layers.
        log_scale_range: Bounds of the logarithm of the scale.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        space: StyleEncoding | None,
        widths: Sequence[int] = (512, 512, 512),
        *,
        log_scale_range: tuple[float, float] = (-5.0, 2.0),
        **trunk: Any,
    ) -> None:
        super().__init__()
        low, high = log_scale_range
        if not low < high:
            raise ValueError(f"log_scale_range must be (low, high) with low < high, got {log_scale_range}")
        self.space = space
        self.log_scale_range = (float(low), float(high))
        self.trunk = ResidualMLP(obs_dim + (space.dim if space is not None else 0), 2 * action_dim, widths, **trunk)

    def forward(self, observation: Tensor, style: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return location and scale, both `(..., action_dim)` float32, for raw (not encoded) `style`."""
        if self.space is None:
            out = self.trunk(observation)
        elif style is None:
            raise ValueError("this policy is conditioned on a style: pass theta as the second argument")
        else:
            out = self.trunk(observation, self.space.encode(style))
        loc, raw = out.chunk(2, -1)
        low, high = self.log_scale_range
        return loc, torch.exp(torch.tanh(raw) * (0.5 * (high - low)) + 0.5 * (high + low))


def make_gaussian_actor(
    obs_dim: int,
    action_dim: int,
    space: StyleEncoding | None,
    widths: Sequence[int] = (512, 512, 512),
    *,
    log_scale_range: tuple[float, float] = (-5.0, 2.0),
    action_spec: Bounded | None = None,
    **trunk: Any,
) -> ProbabilisticActor:
    """Build a tanh-Gaussian policy over actions in [-1, 1].

    Args:
        obs_dim: Width of the observation.
        action_dim: Number of action dimensions.
        space: Style space; theta is read from the key `style` and encoded inside. `None` for no style.
        widths: Widths of the residual layers.
        log_scale_range: Bounds of the logarithm of the scale, see :class:`GaussianPolicy`.
        action_spec: Spec of the action; default [-1, 1] in every dimension.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.

    Returns:
        A `ProbabilisticActor` reading `observation` and `style`, writing `loc`, `scale` and `action`.
    """
    policy = GaussianPolicy(obs_dim, action_dim, space, widths, log_scale_range=log_scale_range, **trunk)
    in_keys: list[Any] = ["observation"] if space is None else ["observation", STYLE]
    module = TensorDictModule(policy, in_keys=in_keys, out_keys=["loc", "scale"])  # pyright: ignore[reportArgumentType]
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        spec=Bounded(-1.0, 1.0, torch.Size([action_dim]), dtype=torch.float32) if action_spec is None else action_spec,
        distribution_class=TanhGaussian,
    )
