"""Checks that keep non-finite numbers out of the replay buffer and the weights."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

LARGEST = 1e18  # float32 ends at 3.4e38: squares of larger numbers, summed over a batch, are infinite


class NonFiniteError(ValueError):
    """A number is NaN, infinite, or so large that its square is infinite."""


def require_finite(data: TensorDictBase) -> None:
    """Refuse collected transitions that would poison the replay buffer and then the weights.

    Args:
        data: Transitions `(environments, steps)` or `(steps,)`; all floating-point entries are checked, including
            nested ones.

    Raises:
        NonFiniteError: If a number is NaN, infinite or beyond `LARGEST`; the message names the first such step, its
            environment and the entries.
    """
    steps = data.batch_size[-1]
    floats = {key: value for key, value in data.items(True, True) if value.is_floating_point() and value.numel()}
    bad = {key: value.reshape(-1, steps, value.numel() // data.numel()) for key, value in floats.items() if _bad(value)}
    if not bad:
        return
    # Report the first step, and the first environment in that step.
    marked = torch.stack([_beyond(value).any(-1).T for value in bad.values()]).any(0)
    step, row = marked.nonzero()[0].tolist()
    at_fault = {key: value[row, step][_beyond(value[row, step])] for key, value in bad.items()}
    found = [f"{key if isinstance(key, str) else '/'.join(key)} is {v[0]:g}" for key, v in at_fault.items() if len(v)]
    raise NonFiniteError(
        f"{', '.join(found)} in environment {row}, step {step + 1} of {steps} of the last batch, of which nothing was "
        f"stored: expected finite numbers up to {LARGEST:g}. Look at the environment's step function and at the style "
        "terms; an episode whose physics explode has to end."
    )


def require_action(action: Tensor, num_envs: int, width: int) -> None:
    """Refuse actions of another shape, and those that contain NaN.

    Args:
        action: Actions `(num_envs, width)`.
        num_envs: Number of environments.
        width: Numbers of an action.

    Raises:
        NonFiniteError: If an action contains NaN; the message names the first such environment.
        ValueError: If the shape is another one.
    """
    if action.shape != (num_envs, width):
        raise ValueError(f"action has the shape {tuple(action.shape)}: expected ({num_envs}, {width})")
    missing = action.isnan()
    if missing.any():
        row = missing.flatten(1).any(1).nonzero()[0].item()
        raise NonFiniteError(
            f"action contains NaN in environment {row}: the policy has diverged, or its observation is not finite."
        )


def _bad(value: Tensor) -> bool:
    low, high = value.aminmax()  # NaN if any entry is, and then no comparison holds
    return not (bool(low >= -LARGEST) and bool(high <= LARGEST))


def _beyond(value: Tensor) -> Tensor:
    return ~(value.abs() <= LARGEST)
