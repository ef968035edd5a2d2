"""Style features and flat observations of one step of a Gymnasium environment."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

Features: TypeAlias = Callable[[Any, Any, dict[str, Any]], ArrayLike]
"""Function `(observation, action, info) -> (F,)` that computes the style features of one step, independent of theta.

The arguments are the environment's own: the observation after the step, the action of the step, and its info.
"""


def checked_features(features: ArrayLike) -> np.ndarray:
    """Return the features of a step as float32 (F,).

    Raises:
        ValueError: If they have another shape, or are not numbers.
    """
    try:
        array = np.array(features, dtype=np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"features returned {features!r}: expected (F,), the numbers of a single step") from None
    if array.ndim != 1:
        raise ValueError(f"features returned shape {array.shape}: expected (F,), the numbers of a single step")
    return array


def flat_observation(space: spaces.Space, observation: Any) -> np.ndarray:
    """Return an observation as a vector (D,), where D is `flatdim(space)`.

    Raises:
        ValueError: If the observation is not of that kind, such as a dictionary without one of the space's keys.
    """
    try:
        flat = spaces.flatten(space, observation)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"an observation does not fit its space {space} ({reason}): {observation!r}") from error
    assert isinstance(flat, np.ndarray)  # flatdim has raised for spaces without a fixed size
    return flat
