"""Bookkeeping of steps: the stream of each step, and where episodes begin and end."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from tensordict import LazyStackedTensorDict, TensorDictBase
from torch import Tensor

TRAJECTORY = ("collector", "traj_ids")
_MASK = ("collector", "mask")


@dataclass
class Steps:
    """Bookkeeping of consecutive steps of many streams, on the CPU; rows of one stream are in the order of time.

    A stream is a trajectory if the collector numbers trajectories, otherwise an environment.
    """

    stream: np.ndarray  # (steps,) int64
    ends: np.ndarray  # (steps,) bool, last step of an episode, terminated or truncated
    fired: np.ndarray  # (steps, event tables) bool
    route: np.ndarray  # (steps,) int64, routed table of the step
    arrival: np.ndarray  # (steps,) int64, number of steps received before

    def __len__(self) -> int:
        return len(self.stream)

    def __getitem__(self, rows: np.ndarray) -> "Steps":
        return Steps(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})

    @staticmethod
    def unrelated(n: int) -> "Steps":
        """Return the bookkeeping of `n` steps whose order does not matter."""
        yes_no, number = np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64)
        return Steps(number, yes_no, np.zeros((n, 0), dtype=bool), number, number)

    @staticmethod
    def cat(parts: "Sequence[Steps]") -> "Steps":
        """Concatenate bookkeeping in the order of time."""
        return Steps(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Steps)})

    def state_dict(self) -> dict[str, Tensor]:
        """Return the columns as tensors `(steps,)` by name."""
        return {f.name: torch.from_numpy(getattr(self, f.name).copy()) for f in fields(self)}

    @staticmethod
    def from_state_dict(state: dict[str, Tensor]) -> "Steps":
        """Return the bookkeeping from what `state_dict` returned."""
        return Steps(**{f.name: state[f.name].cpu().numpy().copy() for f in fields(Steps)})

    def in_episodes(self) -> "Episodes":
        """Sort the steps by stream and divide them into episodes."""
        order = np.argsort(self.stream, kind="stable")
        stream, ends = self.stream[order], self.ends[order]
        first_of_stream = np.ones(len(order), dtype=bool)
        first_of_stream[1:] = stream[1:] != stream[:-1]
        first = first_of_stream.copy()
        first[1:] |= ends[:-1]
        starts = np.flatnonzero(first)
        return Episodes(
            order=order,
            stream=stream,
            ends=ends,
            first_of_stream=first_of_stream,
            number=np.cumsum(first) - 1,
            start=starts,
            last=np.append(starts[1:] - 1, len(order) - 1),
        )


@dataclass
class Episodes:
    """Steps sorted by stream and divided into episodes or parts of them, called pieces."""

    order: np.ndarray  # (steps,) row of each sorted step
    stream: np.ndarray  # (steps,)
    ends: np.ndarray  # (steps,)
    first_of_stream: np.ndarray  # (steps,) bool
    number: np.ndarray  # (steps,) piece of each step
    start: np.ndarray  # (pieces,) sorted position of the first step
    last: np.ndarray  # (pieces,) sorted position of the last step


def flatten_time_major(data: TensorDictBase) -> tuple[TensorDictBase, int | None]:
    """Flatten a batch such that the steps of each environment are in the order of time.

    Args:
        data: Transitions `(steps,)`, already time-major, or `(num_envs, time)` as TorchRL's collectors yield them.

    Returns:
        The transitions `(steps,)`, and the number of environments or None if the batch had one dimension.

    Raises:
        ValueError: If the batch has neither one nor two dimensions.
    """
    if data.ndim not in (1, 2):
        raise ValueError(
            f"extend got a batch of shape {tuple(data.shape)}: expected (steps,), time-major, or (num_envs, time) as "
            "collectors yield it"
        )
    num_envs = None
    if isinstance(data, LazyStackedTensorDict):
        data = data.contiguous()  # a lazy stack, such as a rollout, is a hundred times slower to flatten
    if data.ndim == 2:
        num_envs = data.shape[0]
        data = data.transpose(0, 1).reshape(-1)
    mask = data.get(_MASK, None)
    if mask is not None and not bool(mask.all()):
        data = data[mask]  # padding of `split_trajs`
    return data, num_envs


def read_steps(data: TensorDictBase, num_envs: int | None, arrived: int) -> Steps:
    """Return the streams and episode ends of steps, without events and routes.

    Args:
        data: Transitions `(steps,)`.
        num_envs: Number of environments in the batch; needed if the data has no trajectory numbers.
        arrived: Number of steps received before.

    Raises:
        ValueError: If the stream of a step is unknown, or the data has no `("next", "done")`.
    """
    n = len(data)
    done = data.get(("next", "done"), None)
    if done is None:
        raise ValueError("the data has no ('next', 'done'): expected transitions as TorchRL's collectors yield them")
    trajectory = data.get(TRAJECTORY, None)
    if trajectory is not None:
        stream = trajectory.reshape(n, -1)[:, 0].to("cpu", torch.int64).numpy()
    elif num_envs is None:
        raise ValueError(
            f"cannot tell which of the {n} steps belong to one episode: give EventTableBuffer num_envs (batches are "
            f"then read as time-major), extend with (num_envs, time) batches, or keep {TRAJECTORY} in the data"
        )
    elif n % num_envs:
        raise ValueError(f"extend got {n} steps of {num_envs} environments: expected a multiple (num_envs)")
    else:
        stream = np.arange(n) % num_envs
    steps = Steps.unrelated(n)
    steps.stream = stream
    steps.ends = done.reshape(n, -1).any(-1).cpu().numpy()
    steps.arrival = arrived + np.arange(n)
    return steps
