"""Style-conditioned tanh-Gaussian policies."""

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor

from coachable.distributions.tanh_normal import TanhGaussian
from coachable.keys import STYLE
from coachable.networks.residual import ResidualMLP


class StyleEncoding(Protocol):
    """Part of a `StyleSpace` that a network uses."""

    @property
    def dim(self) -> int:
        """Width of theta."""
        ...

    def encode(self, theta: Tensor, /) -> Tensor:
        """Scale theta `(..., dim)` to about [-1, 1]."""
        ...


class TensorModule(TensorDictModule):
    """`TensorDictModule` that writes the tensors of its network without conversion.

    The base class checks each output for a conversion and looks for pandas on disk, which takes 5 % of an update.
    """

    def _write_to_tensordict(
        self,
        tensordict: TensorDictBase,
        tensors: Sequence[Tensor],
        tensordict_out: TensorDictBase | None = None,
        out_keys: Iterable[NestedKey] | None = None,
    ) -> TensorDictBase:
        written = tensordict if tensordict_out is None else tensordict_out
        for key, tensor in zip(self.out_keys_source if out_keys is None else out_keys, tensors, strict=True):
            written.set(key, tensor)
        return written


class StyleNetwork(nn.Module):
    """Residual network of `cat(observation, encode(theta), further inputs)`.

    Args:
        space: Style space that encodes theta; None for a network without style.
        inputs: Total width of the other inputs.
        outputs: Width of the head.
        widths: Widths of the residual layers.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.
    """

    def __init__(
        self, space: StyleEncoding | None, inputs: int, outputs: int, widths: Sequence[int], **trunk: Any
    ) -> None:
        super().__init__()
        self.space = space
        self.trunk = ResidualMLP(inputs + (0 if space is None else space.dim), outputs, widths, **trunk)

    def in_keys(self, *inputs: str) -> list[Any]:
        """Return the keys of the arguments of `forward`: those of the inputs, and `style` if there is a style space."""
        return [*inputs] if self.space is None else [*inputs, STYLE]

    def head(self, observation: Tensor, style: Tensor | None, *further: Tensor) -> Tensor:
        """Return the output of the head.

        Args:
            observation: Observation `(..., obs_dim)`.
            style: Raw style `(..., d)`, encoded here; None without a style space.
            *further: Further inputs `(..., d_i)`, after the encoded style.

        Returns:
            Output `(..., outputs)`.

        Raises:
            ValueError: If the network has a style space and `style` is None.
        """
        if self.space is None:
            return self.trunk(observation, *further)
        if style is None:
            raise ValueError(
                "this network is conditioned on a style and got none: expected theta as its last argument, or in a "
                f"tensordict under {STYLE!r}, of which losses also read {('next', STYLE)}"
            )
        return self.trunk(observation, self.space.encode(style), *further)


class GaussianPolicy(StyleNetwork):
    """Network of location and scale of a diagonal Gaussian over actions before the tanh.

    The trunk's input is `cat(observation, encode(theta))`. The scale is `exp(l + (h - l)/2 (tanh(raw) + 1))` with
    `log_scale_range=(l, h)`; with `(-2, 2)` it is `exp(2 tanh(raw))`, as in the paper's RAC.

    Args:
        obs_dim: Width of the observation.
        action_dim: Number of action dimensions.
        space: Style space that encodes theta; None for a policy without style.
        widths: Widths of the residual layers.
        log_scale_range: Bounds of the logarithm of the scale.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        space: StyleEncoding | None,
        widths: Sequence[int],
        *,
        log_scale_range: tuple[float, float],
        **trunk: Any,
    ) -> None:
        super().__init__(space, obs_dim, 2 * action_dim, widths, **trunk)
        low, high = log_scale_range
        if not low < high:
            raise ValueError(f"log_scale_range must be (low, high) with low < high, got {log_scale_range}")
        self.log_scale_range = (float(low), float(high))

    def forward(self, observation: Tensor, style: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return location and scale of the tanh-Gaussian.

        Args:
            observation: Observation `(..., obs_dim)`.
            style: Raw style `(..., d)`, encoded here; None without a style space.

        Returns:
            Location and scale, both `(..., action_dim)` float32. The scale is `exp(l + (h - l)(tanh(raw) + 1) / 2)`
            with the bounds (l, h) of its logarithm.

        Raises:
            ValueError: If the network has a style space and `style` is None.
        """
        loc, raw = self.head(observation, style).chunk(2, -1)
        low, high = self.log_scale_range
        return loc, torch.exp(torch.tanh(raw) * (0.5 * (high - low)) + 0.5 * (high + low))


def make_gaussian_actor(
    obs_dim: int,
    action_dim: int,
    space: StyleEncoding | None,
    widths: Sequence[int] = (512, 512, 512),
    *,
    log_scale_range: tuple[float, float] = (-5.0, 2.0),
    **trunk: Any,
) -> ProbabilisticActor:
    """Build a tanh-Gaussian policy over actions in [-1, 1].

    Args:
        obs_dim: Width of the observation.
        action_dim: Number of action dimensions.
        space: Style space that encodes theta, which is read from the key `style`; None for no style.
        widths: Widths of the residual layers.
        log_scale_range: Bounds of the logarithm of the scale, see :class:`GaussianPolicy`.
        **trunk: Further arguments of :class:`~coachable.networks.residual.ResidualMLP`.

    Returns:
        A `ProbabilisticActor` that reads `observation` and `style` and writes `loc`, `scale` and `action`.
    """
    policy = GaussianPolicy(obs_dim, action_dim, space, widths, log_scale_range=log_scale_range, **trunk)
    out_keys: list[Any] = ["loc", "scale"]
    module = TensorModule(policy, in_keys=policy.in_keys("observation"), out_keys=out_keys)
    return ProbabilisticActor(
        module,
        in_keys=["loc", "scale"],
        spec=Bounded(-1.0, 1.0, torch.Size([action_dim]), dtype=torch.float32),
        distribution_class=TanhGaussian,
    )
