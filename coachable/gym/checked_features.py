"""What a user's function says about one step of a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

__all__ = ["Features", "checked_features", "flat_observation"]

Features: TypeAlias = Callable[[Any, Any, dict[str, Any]], ArrayLike]
"""`(observation, action, info) -> (F,)`: what one step of one environment says about its style, free of theta.

Arguments are the environment's own: the observation after the step, the action that led there, the step's info.
"""


def checked_features(features: ArrayLike) -> np.ndarray:
    """The function's result as (F,) float32.

    Raises:
        ValueError: If it has another shape.
    """
    array = np.array(features, dtype=np.float32)
    if array.ndim != 1:
        raise ValueError(
            f"features returned shape {array.shape}: expected (F,), the numbers of one environment's step."
        )
    return array


def flat_observation(space: spaces.Space, observation: Any) -> np.ndarray:
    """An observation as (D,), D being `flatdim(space)`."""
    flat = spaces.flatten(space, observation)
    assert isinstance(flat, np.ndarray)  # flatdim raises before for spaces without a fixed size
    return flat
