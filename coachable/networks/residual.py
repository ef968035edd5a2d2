"""Padded residual network of the paper's policies and critics.

Every layer is `block(x) = ReLU(LayerNorm(W x + b)) + fit(x)`. `fit` has no parameters. It pads the input with zeros, or
cuts it, to the width of the layer. Heads are linear. Source: the paper, Appendix C, Models (arXiv 2607.00642).

Dropout, as in the racing policies of Wurman et al. 2022, is applied only while gradients are enabled. A policy that
collects, is evaluated or computes the actions of a target therefore has no dropout, even if it is not in evaluation
mode.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from coachable.ranges import Range

Side = Literal["end", "beginning"]


def fit_features(x: Tensor, width: int, side: Side = "end") -> Tensor:
    """Pad or cut the last dimension of `x` to `width` (the identity path of a residual layer).

    Args:
        x: Features `(..., n)`.
        width: New size of the last dimension.
        side: Side that is padded or cut: if `x` is narrower, `"end"` gives `[x, 0]` and `"beginning"` gives `[0, x]`.

    Returns:
        Features `(..., width)`: `x` itself if it has that width, and a view if it is cut.

    Example:
        >>> fit_features(torch.tensor([1.0, 2.0]), 3, side="beginning").tolist()
        [0.0, 1.0, 2.0]
        >>> fit_features(torch.tensor([1.0, 2.0, 3.0]), 2, side="beginning").tolist()
        [2.0, 3.0]
    """
    missing = width - x.shape[-1]
    if missing == 0:
        return x
    if missing > 0:
        return F.pad(x, (0, missing) if side == "end" else (missing, 0))
    return x[..., :width] if side == "end" else x[..., -width:]


class ResidualBlock(nn.Module):
    """Layer `ReLU(LayerNorm(W x + b)) + fit(x)`.

    Args:
        in_features: Width of the input.
        out_features: Width of the output.
        side: Padding side of the identity path, see :func:`fit_features`.
        dropout: Probability with which a unit is dropped after the ReLU, in training mode with gradients enabled.
    """

    def __init__(self, in_features: int, out_features: int, *, side: Side = "end", dropout: float = 0.0) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, out_features)
        self.norm = nn.LayerNorm(out_features)
        self.side: Side = side
        self.dropout = nn.Dropout(dropout) if dropout else None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialise as in the paper: Glorot-uniform weight, zero bias, identity layer norm."""
        nn.init.xavier_uniform_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)
        self.norm.reset_parameters()

    def forward(self, x: Tensor) -> Tensor:
        """Map `(..., in_features)` to `(..., out_features)`."""
        hidden = F.relu(self.norm(self.linear(x)))
        if self.dropout is not None and torch.is_grad_enabled():
            hidden = self.dropout(hidden)
        return hidden + fit_features(x, hidden.shape[-1], self.side)

    def extra_repr(self) -> str:
        """Return the padding of the identity path, for `repr`."""
        return f"side={self.side!r}"


class ResidualMLP(nn.Module):
    """Stack of residual layers with a linear head.

    Layers pad their input alternately at the end and at the beginning. Layers of equal width do not pad.

    Args:
        in_features: Width of the input.
        out_features: Width of the head.
        widths: Widths of the layers. The paper uses three of 512 (humanoid), 4096, 2048, 1024, 512 (combat).
        head_gain: Factor on the head's initial weights. With 1 (paper) and inputs of unit size, the outputs have a
            standard deviation of about 2, where tanh is almost flat, so that policies may need less.
        dropout: Probability with which a layer's unit is dropped while learning, see the module.

    Raises:
        ValueError: If a width is not positive, or `dropout` is not in [0, 1).

    Example:
        >>> ResidualMLP(10, 2, widths=(64, 64))(torch.zeros(5, 10)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        widths: Sequence[int] = (512, 512, 512),
        *,
        head_gain: float = 1.0,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        if not widths or min(in_features, *widths) < 1:
            raise ValueError(f"widths must be positive and at least one, got in_features={in_features}, {widths=}")
        Range("[0, 1)").check("dropout", dropout)
        self.in_features = in_features
        self.out_features = out_features
        ins = (in_features, *widths[:-1])
        self.blocks = nn.Sequential(
            *(
                ResidualBlock(ins[k], o, side="beginning" if k % 2 else "end", dropout=dropout)
                for k, o in enumerate(widths)
            )
        )
        self.head = nn.Linear(widths[-1], out_features)
        nn.init.xavier_uniform_(self.head.weight, gain=head_gain)
        nn.init.zeros_(self.head.bias)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Map inputs `(..., d_i)`, concatenated to `in_features`, to `(..., out_features)`.

        Float64 inputs are cast to the parameters' dtype. The head runs in float32, also under autocast, because values
        and log-probabilities need more precision than bfloat16.

        Raises:
            ValueError: If the inputs have another width.
        """
        x = inputs[0] if len(inputs) == 1 else torch.cat(inputs, -1)
        if x.shape[-1] != self.in_features:
            widths = " + ".join(str(part.shape[-1]) for part in inputs)
            raise ValueError(
                f"the network has {self.in_features} inputs, but got {widths} = {x.shape[-1]} (observation, style and, "
                "for a critic, action): expected the widths with which it was made"
            )
        if x.dtype == torch.float64:  # observations of dm_control
            x = x.to(self.head.weight.dtype)
        hidden = self.blocks(x)
        with torch.autocast(x.device.type, enabled=False):
            return self.head(hidden.to(self.head.weight.dtype))


def with_new_inputs(weights: Mapping[str, Tensor], seen: int, new: int) -> dict[str, Tensor]:
    """Return the state of a :class:`ResidualMLP` with more inputs and, while these are 0, the same outputs.

    The weights of the new inputs are 0. If the first layer is wider than its input, the identity path maps the inputs
    after the new ones to other units. The units of all layers are reordered accordingly, and the new inputs are mapped
    to units to which no input was mapped before.

    Args:
        weights: State of a network whose first layer pads at the end, `blocks.0.linear.weight` and so on. It may have
            leading dimensions, for a stack of critics.
        seen: Number of inputs before the new ones.
        new: Number of new inputs.

    Raises:
        ValueError: If there is no such state, because layers differ in width or the first one ends among the inputs.
    """
    first = weights["blocks.0.linear.weight"]
    width, inputs = first.shape[-2:]
    wide = dict(weights)
    wide["blocks.0.linear.weight"] = torch.cat(
        [first[..., :seen], first.new_zeros(*first.shape[:-1], new), first[..., seen:]], -1
    )
    if width <= seen:  # the identity path ends before the new inputs
        return wide
    widths = [value.shape[-1] for name, value in weights.items() if name.endswith("linear.bias")]
    if width < inputs + new or set(widths) != {width}:
        raise ValueError(
            f"layers of {widths} units cannot get {new} inputs after the first {seen} of {inputs}: expected equal "
            f"layers of at most {seen} or at least {inputs + new} units"
        )
    units = torch.arange(width)
    moved = (units[:seen], units[inputs : inputs + new], units[seen:inputs], units[inputs + new :])
    order = torch.cat(moved).to(first.device)
    for name, value in wide.items():
        linear = name.endswith("linear.weight")
        if name.startswith("blocks."):  # its outputs are units
            value = value.index_select(-2 if linear else -1, order)
        if name == "head.weight" or (linear and not name.startswith("blocks.0.")):  # its inputs are units
            value = value.index_select(-1, order)
        wide[name] = value
    return wide
