"""A policy's weights as one flat vector, and a copy of the policy that can be sent to another machine."""

from copy import deepcopy

import torch
from torch import Tensor, nn


def weights_of(policy: nn.Module) -> list[Tensor]:
    """Return all parameters and buffers of floating point."""
    return [value for value in (*policy.parameters(), *policy.buffers()) if value.is_floating_point()]


@torch.no_grad()
def flat_weights(weights: list[Tensor], out: Tensor | None = None) -> Tensor:
    """Return weights from `weights_of` as one vector `(n,)` float32 in the CPU's memory.

    Args:
        weights: The weights.
        out: An earlier result, to write to it instead of new memory, which takes ten times as long.
    """
    parts = [weight.reshape(-1) for weight in weights]
    if out is None:
        out = torch.empty(sum(map(len, parts)))
    if parts[0].device == out.device:
        return torch.cat(parts, out=out)
    return out.copy_(torch.cat(parts))


def load_flat_weights(policy: nn.Module, flat: Tensor) -> None:
    """Copy what `flat_weights` returned into a policy of the same shape.

    Args:
        policy: Policy of the same shape.
        flat: Weights (n,) in the order of `flat_weights`.

    Raises:
        ValueError: If the number of weights differs.
    """
    values = weights_of(policy)
    expected = sum(value.numel() for value in values)
    if flat.numel() != expected:
        raise ValueError(f"got {flat.numel()} weights: expected {expected}")
    with torch.no_grad():
        for value, part in zip(values, flat.split([value.numel() for value in values]), strict=True):
            value.copy_(part.view_as(value))


def portable_copy(policy: nn.Module) -> nn.Module:
    """Return a copy of a policy on the CPU that shares no memory with it and has no gradients."""
    copy = deepcopy(policy).cpu().requires_grad_(False)
    for value in (*copy.parameters(), *copy.buffers()):
        value.data = value.data.clone()  # parameters may be views of one vector, all of which would be pickled
        value.grad = None
    return copy
