"""Conversion between Gymnasium action spaces and the action tensor: categorical heads, then axes."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces


def action_components(space: spaces.Space) -> tuple[list[int], int]:
    """Return the sizes of an action space's categorical components and its number of continuous entries.

    Raises:
        ValueError: If the space has a component of another kind, one with a single choice, or a `Box` without finite
            bounds.
    """
    match space:
        case spaces.Discrete() if space.n > 1:
            return [int(space.n)], 0
        case spaces.MultiDiscrete() if (space.nvec > 1).all():
            return space.nvec.reshape(-1).tolist(), 0
        case spaces.MultiBinary():
            return [2] * int(np.prod(space.shape)), 0
        case spaces.Box() if np.isfinite(space.low).all() and np.isfinite(space.high).all():
            return [], int(np.prod(space.shape))
        case spaces.Tuple() | spaces.Dict():
            parts = [action_components(part) for part in (space.values() if isinstance(space, spaces.Dict) else space)]
            return [size for sizes, _ in parts for size in sizes], sum(axes for _, axes in parts)
    raise ValueError(
        f"the action space {space} is not supported: expected Box with finite bounds, Discrete or MultiDiscrete with "
        "two choices or more, MultiBinary, or a Tuple or Dict of these"
    )


def native_action(space: spaces.Space, choices: Iterator[int], axes: Iterator[float]) -> Any:
    """Make an action of a space from the next choices (indices) and axes (in [-1, 1]).

    Args:
        space: Space of the environment's actions, possibly nested.
        choices: Indices of the discrete entries, in order.
        axes: Values of the continuous entries in [-1, 1], in order.

    Returns:
        An element of the space.

    Raises:
        AssertionError: If the space is of an unknown type.
    """
    match space:
        case spaces.Discrete():
            return space.start + next(choices)
        case spaces.MultiDiscrete():
            taken = [next(choices) for _ in range(space.nvec.size)]
            return space.start + np.array(taken, dtype=space.dtype).reshape(space.shape)
        case spaces.MultiBinary():
            return np.array([next(choices) for _ in range(int(np.prod(space.shape)))], np.int8).reshape(space.shape)
        case spaces.Box():
            unit = np.array([next(axes) for _ in range(space.low.size)]).reshape(space.shape)
            low, high = np.float64(space.low), np.float64(space.high)  # small types cannot hold high - low
            scaled = (low + (high - low) * 0.5 * (unit + 1.0)).clip(low, high)
            return (scaled.round() if np.issubdtype(space.dtype, np.integer) else scaled).astype(space.dtype)
        case spaces.Tuple():
            return tuple(native_action(part, choices, axes) for part in space)
        case spaces.Dict():
            return {name: native_action(part, choices, axes) for name, part in space.items()}
    raise AssertionError(space)  # action_components has refused it before
