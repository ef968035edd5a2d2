"""Interface of a collector whose workers go on while the learner learns."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor


class AsyncCollector(ABC):
    """Iterator of batches that workers collect on their own.

    A batch has rows of one or more workers. Read row by row, the steps of a trajectory are in their order. Trajectory
    numbers, `("collector", "traj_ids")`, never repeat.
    """

    @abstractmethod
    def __iter__(self) -> Iterator[TensorDictBase]:
        """Start the workers, and return an endless iterator of batches `(rows, time)`."""

    @abstractmethod
    def has_batch(self, wait: float = 0.0) -> bool:
        """Return whether the next batch, or an error instead of it, is here, so that taking it does not wait.

        Args:
            wait: Longest time to wait for it [s].
        """

    @abstractmethod
    def after_update(self, updates: int) -> None:
        """Offer the policy's weights to the workers, if it is time to.

        Args:
            updates: Number of updates so far, which is the version of the weights.
        """

    @abstractmethod
    def interrupted(self) -> Tensor:
        """Return the trajectories that ended with their worker since the last call.

        Returns:
            Trajectory numbers `(trajectories,)` of which all steps that arrived are in the batches so far.
        """

    @abstractmethod
    def metrics(self) -> dict[str, float]:
        """Return the metrics of the workers since the last call, and reset them."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return the counts for a checkpoint, in plain containers."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, before the first batch."""

    @abstractmethod
    def shutdown(self) -> None:
        """End all workers."""
